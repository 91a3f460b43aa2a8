"""Checkpoints are whole or not there, and know what they are of."""

import numpy as np
import pytest

from uard import InvalidValueError
from uard.training import checkpoint
from uard.training.checkpoint import CheckpointError

STATE = {"a": np.arange(6.0).reshape(2, 3), "b": (np.array([True, False]), np.array(7, np.int64)), "c": ()}
LIKE = {"a": np.zeros((4, 3)), "b": (np.zeros(2, bool), np.array(0, np.int64)), "c": ()}


@pytest.fixture
def saved(tmp_path):
    path = tmp_path / "new" / "x.checkpoint"
    checkpoint.save(path, "cell 3", STATE)
    return path


def test_what_was_saved_is_loaded_to_the_bit_and_first_axes_may_grow(saved):
    found = checkpoint.load(saved, "cell 3", LIKE)
    np.testing.assert_array_equal(found["a"], STATE["a"])
    np.testing.assert_array_equal(found["b"][0], STATE["b"][0])
    assert found["b"][1] == 7
    assert found["c"] == ()
    assert [p.name for p in saved.parent.iterdir()] == ["x.checkpoint"]  # no half files


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.99])
def test_a_truncated_file_is_refused_and_says_what_to_do(saved, share):
    data = saved.read_bytes()
    saved.write_bytes(data[: int(share * len(data))])
    with pytest.raises(CheckpointError, match=r"truncated.*delete"):
        checkpoint.load(saved, "cell 3", LIKE)


def test_an_altered_byte_is_noticed(saved):
    data = bytearray(saved.read_bytes())
    data[-20] ^= 1
    saved.write_bytes(bytes(data))
    with pytest.raises(CheckpointError, match="checksum"):
        checkpoint.load(saved, "cell 3", LIKE)


def test_another_configuration_is_refused_by_name(saved):
    with pytest.raises(CheckpointError, match="cell 3, not cell 4"):
        checkpoint.load(saved, "cell 4", LIKE)


def test_a_configuration_of_several_lines_could_not_be_read_again(tmp_path):
    with pytest.raises(InvalidValueError, match=r"config = 'one\\ntwo': must be one line of text"):
        checkpoint.save(tmp_path / "c", "one\ntwo", {"a": np.ones(2)})
    assert not (tmp_path / "c").exists()


def test_another_structure_is_refused(saved):
    with pytest.raises(CheckpointError, match="does not fit"):
        checkpoint.load(saved, "cell 3", {**LIKE, "a": np.zeros((4, 2))})


def test_nan_is_never_written_and_the_last_good_one_survives(saved):
    before = saved.read_bytes()
    with pytest.raises(FloatingPointError, match=r"\['a'\]"):
        checkpoint.save(saved, "cell 3", {**STATE, "a": np.array([[1.0, np.nan, 0.0]])})
    assert saved.read_bytes() == before


def test_a_disk_that_is_full_leaves_the_last_good_one(saved, monkeypatch):
    before = saved.read_bytes()

    def full(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match="No space"):
        checkpoint.save(saved, "cell 3", STATE)
    assert saved.read_bytes() == before
    assert [p.name for p in saved.parent.iterdir()] == ["x.checkpoint"]
