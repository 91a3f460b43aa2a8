"""One writer for all files: whole or not at all, links followed, devices and pipes never replaced."""

import os
import stat
import subprocess
import sys
import threading

import pytest

from uard import InvalidValueError
from uard._support import files


def names(folder):
    return sorted(p.name for p in folder.iterdir())


def test_a_file_is_replaced_as_a_whole_and_keeps_its_permissions(tmp_path):
    target = tmp_path / "deep" / "x.json"
    files.write(target, "one", "json")
    assert stat.S_IMODE(target.stat().st_mode) == 0o666 & ~current_umask()
    target.chmod(0o640)
    other = tmp_path / "deep" / "hard"
    os.link(target, other)
    files.write(target, "zwei ü", "json")
    assert target.read_text(encoding="utf-8") == "zwei ü"
    assert stat.S_IMODE(target.stat().st_mode) == 0o640
    assert other.read_text() == "one", "a new file took its place; nobody saw half of it"
    assert names(target.parent) == ["hard", "x.json"]


def current_umask():
    value = os.umask(0o022)
    os.umask(value)
    return value


def test_an_error_while_writing_leaves_what_was_there_and_nothing_else(tmp_path):
    target = tmp_path / "x"
    target.write_text("old")

    def half_written():
        with files.replacing(target) as file:
            file.write(b"new")
            file.flush()
            assert target.read_text() == "old"
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        half_written()
    assert target.read_text() == "old"
    assert names(tmp_path) == ["x"]


@pytest.mark.parametrize("there", [True, False])
def test_links_are_followed(tmp_path, there):
    real = tmp_path / "there" / "real"
    real.parent.mkdir()
    if there:
        real.write_text("old")
    (tmp_path / "middle").symlink_to("there/real")
    (tmp_path / "link").symlink_to(tmp_path / "middle")
    files.prepare(tmp_path / "link", "json")
    files.write(tmp_path / "link", "new", "json")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "middle").is_symlink()
    assert real.read_text() == "new"
    assert names(real.parent) == ["real"]


def test_a_circle_of_links_is_an_error(tmp_path):
    (tmp_path / "a").symlink_to("b")
    (tmp_path / "b").symlink_to("a")
    for act in (lambda: files.write(tmp_path / "a", "x", "json"), lambda: files.prepare(tmp_path / "a", "json")):
        with pytest.raises(InvalidValueError, match=r"json = .*must be a file that can be written \(.*symbolic links"):
            act()


def test_a_pipe_gets_the_text_and_stays_a_pipe(tmp_path):
    fifo, got = tmp_path / "fifo", []
    os.mkfifo(fifo)
    files.prepare(fifo, "json")
    reader = threading.Thread(target=lambda: got.append(fifo.read_text()))
    reader.start()
    files.write(fifo, "through", "json")
    reader.join(10)
    assert got == ["through"]
    assert stat.S_ISFIFO(fifo.stat().st_mode)
    assert names(tmp_path) == ["fifo"]


def test_the_null_device_stays_one():
    files.prepare("/dev/null", "json")
    files.write("/dev/null", "nothing", "json")
    assert stat.S_ISCHR(os.stat("/dev/null").st_mode)


CODE = """
from uard._support import files
print("before")
files.prepare({0!r}, "json")
files.write({0!r}, "written\\n", "json")
print("after")
"""


@pytest.mark.parametrize("where", ["/dev/stdout", "/dev/fd/1", "/proc/self/fd/1", "link"])
@pytest.mark.parametrize("into", ["pipe", "file"])
def test_standard_output_by_any_name_is_written_to_in_order(tmp_path, where, into):
    (tmp_path / "link").symlink_to("/dev/stdout")
    command = [sys.executable, "-c", CODE.format(where)]
    if into == "pipe":
        done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, check=True).stdout
    else:
        with (tmp_path / "out").open("a") as out:
            out.write("first\n")
            out.flush()
            subprocess.run(command, stdout=out, cwd=tmp_path, check=True)
        done = (tmp_path / "out").read_text().removeprefix("first\n")
    assert done == "before\nwritten\nafter\n"
    assert (tmp_path / "link").is_symlink()


@pytest.mark.parametrize(
    ("path", "says"),
    [
        (".", "must be a file, not a folder"),
        ("", "an empty name"),
        ("file/x", "must be in a folder that can be written"),
        ("n" * 256, "must be a file that can be written .*too long"),
        ("/dev/fd/77", "must be a file that can be written .*Bad file descriptor"),
    ],
)
def test_what_cannot_be_written_is_refused_before_and_after(tmp_path, monkeypatch, path, says):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("mine")
    with pytest.raises(InvalidValueError, match=f"^extract = .*{says}"):
        files.prepare(path, "extract")
    with pytest.raises(InvalidValueError, match=r"^extract = .*must be a file that can be written"):
        files.write(path, "x", "extract")
    assert names(tmp_path) == ["file"]
    assert (tmp_path / "file").read_text() == "mine"


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everything")
def test_a_protected_file_is_not_replaced(tmp_path):
    target = tmp_path / "x"
    target.write_text("mine")
    target.chmod(0o444)
    for act in (files.prepare, lambda path, field: files.write(path, "y", field)):
        with pytest.raises(InvalidValueError, match="write-protected"):
            act(target, "json")
    assert target.read_text() == "mine"


def test_a_name_as_long_as_a_name_may_be(tmp_path):
    files.write(tmp_path / ("n" * 255), "x", "json")
    assert names(tmp_path) == ["n" * 255]


def test_what_is_read_is_not_written_over_by_any_name(tmp_path):
    store, link = tmp_path / "s.sqlite", tmp_path / "link"
    store.write_text("all results")
    link.symlink_to(store)
    for path in (store, link, tmp_path / "." / "s.sqlite"):
        with pytest.raises(InvalidValueError, match=r"json = .*another file than .*s.sqlite, which it would destroy"):
            files.prepare(path, "json", None, store)
    files.prepare(tmp_path / "other", "json", store, "no such file")
    assert store.read_text() == "all results"
