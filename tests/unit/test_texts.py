"""Prompts and completions from files, and pairs."""

import csv
import json
from collections import Counter

import pytest

from uard import InvalidValueError
from uard.collect import Project, clip_item, text_item
from uard.collect.items import LONGEST_TEXT
from uard.collect.texts import pairs, texts


@pytest.fixture
def project(tmp_path):
    return Project.create(tmp_path / "project")


def jsonl(tmp_path, *rows):
    path = tmp_path / "answers.jsonl"
    path.write_text("\n".join(json.dumps(row) for row in rows))
    return path


def said(items):
    return [(item.content["prompt"], item.content["completion"]) for item in items]


def user(text):
    return {"role": "user", "content": text}


def assistant(text):
    return {"role": "assistant", "content": text}


ASKED = "\n\nHuman: a?\n\nAssistant:"


@pytest.mark.parametrize(
    ("row", "expected"),
    [
        ({"prompt": "a?", "completion": "b"}, [("a?", "b")]),
        ({"Question": "a?", "Response": "b", "other": [1]}, [("a?", "b")]),
        ({"prompt": "a?", "completions": ["b", "c", "b"]}, [("a?", "b"), ("a?", "c")]),
        ({"prompt": "a?", "chosen": "b", "rejected": "c"}, [("a?", "b"), ("a?", "c")]),
        ({"prompt": [user("a?")], "completion": [assistant("b")]}, [("a?", "b")]),
        (
            {"prompt": "a?", "chosen": [user("a?"), assistant("b")], "rejected": [user("a?"), assistant("c")]},
            [("a?", "b"), ("a?", "c")],
        ),
        (
            {"chosen": [user("a?"), assistant("b")], "rejected": [user("a?"), assistant("c")]},
            [("a?", "b"), ("a?", "c")],
        ),
        ({"chosen": f"{ASKED} b", "rejected": f"{ASKED} c"}, [(ASKED.strip(), "b"), (ASKED.strip(), "c")]),
        ({"messages": [user("a?"), assistant("b")]}, [("a?", "b")]),
        (
            {"prompt": [{"role": "system", "content": "s"}, user("a?")], "completion": "b"},
            [("system: s\n\nuser: a?", "b")],
        ),
        ({"prompt": [{"role": "user", "content": [{"type": "text", "text": "a?"}]}], "completion": "b"}, [("a?", "b")]),
        ({"prompt": "", "completion": "<script>alert(1)</script>"}, [("", "<script>alert(1)</script>")]),
    ],
)
def test_forms_of_rows(tmp_path, project, row, expected):
    items = texts(jsonl(tmp_path, row), project)
    assert said(items) == expected
    with project.store() as store:
        assert list(store.items()[0]) == items


def test_rewards_and_strata_come_along(tmp_path, project):
    rows = [
        {"prompt": "a?", "completions": ["b", "c"], "rewards": [1, None], "model": "small"},
        {"prompt": "a?", "completions": ["d"], "rewards": 2.5, "model": "large"},
    ]
    items = texts(jsonl(tmp_path, *rows), project)
    assert [(i.reward, i.stratum) for i in items] == [(1.0, "small"), (None, "small"), (2.5, "large")]
    path = jsonl(tmp_path, {"prompt": "a?", "chosen": "b", "rejected": "c", "score_chosen": 8, "score_rejected": 3})
    assert [i.reward for i in texts(path, project)] == [8.0, 3.0]


def test_csv_and_parquet(tmp_path, project):
    table = tmp_path / "answers.csv"
    with table.open("w", newline="") as file:
        csv.writer(file).writerows([("prompt", "completion", "reward"), ("a?", "line\nline", "0.5"), ("a?", "c", "")])
    found = texts(table, project)
    assert said(found) == [("a?", "line\nline"), ("a?", "c")]
    assert [i.reward for i in found] == [0.5, None]
    pa = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    columns = {"prompt": ["a?"], "completions": [["x", "y"]], "chosen_by": ["me"]}
    parquet.write_table(pa.table(columns), tmp_path / "answers.parquet")
    assert said(texts(tmp_path / "answers.parquet", project)) == [("a?", "x"), ("a?", "y")]


GOOD = {"prompt": "a?", "completion": "b"}


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ({"prompt": "a?", "completion": ""}, "row 2, column 'completion' = '': must be text that is not empty"),
        ({"prompt": "a?", "completion": 7}, "row 2, column 'completion' = 7: must be text, or a list of messages"),
        ({"prompt": None, "completion": "b"}, "row 2, column 'prompt' = None: must be text"),
        ({"prompt": "a?", "completion": []}, r"row 2, column 'completion' = \[\]: must be a list with at least one"),
        ({"prompt": "a?", "completion": ["b", 3]}, "row 2, column 'completion' = .*must be text"),
        ({"prompt": [{"role": "user"}], "completion": "b"}, "row 2, column 'prompt' = .*with role and content"),
        (
            {"prompt": [{"role": "user", "content": [{"type": "image"}]}], "completion": "b"},
            "row 2, .*whose content is text",
        ),
        (
            {"prompt": "a?", "completion": "x" * 1_000_000},
            rf"column 'completion' = 'xx.*at most {LONGEST_TEXT} characters, and it has 1000000",
        ),
        ({"prompt": "a?", "completion": "\ud800"}, "row 2, column 'completion' = .*surrogate"),
        ({"prompt": "a?", "completion": "b", "reward": "high"}, "row 2, column 'reward' = 'high': must be a number"),
        (
            {"prompt": "a?", "completion": "b", "reward": [1, 2]},
            r"row 2, column 'reward' = \[1, 2\]: must be a number, or",
        ),
        ({"prompt": "a?", "completion": "b", "reward": 1e200}, "row 2, column 'reward' = 1e"),
        ({"prompt": "a?", "completion": "b", "reward": True}, "row 2, column 'reward' = True: must be a number"),
    ],
)
def test_a_bad_line_is_named_and_nothing_is_added(tmp_path, project, row, message):
    path = jsonl(tmp_path, GOOD | {"reward": 1}, row, GOOD)
    with pytest.raises(InvalidValueError, match=message) as error:
        texts(path, project)
    assert "Nothing was added" in str(error.value)
    with project.store() as store:
        assert store.items()[0] == ()


def test_all_bad_lines_are_named(tmp_path, project):
    rows = [GOOD, {"prompt": "a?", "completion": ""}, GOOD, {"prompt": 1, "completion": "c"}]
    with pytest.raises(InvalidValueError, match=r"row 2, .*Rows that are bad, too \(1\): 4. Nothing was added"):
        texts(jsonl(tmp_path, *rows), project)


def test_a_megabyte_in_a_csv_is_named_by_its_row(tmp_path, project):
    path = tmp_path / "answers.csv"
    path.write_text(f"prompt,completion\na?,b\na?,{'x' * 1_000_000}\n")
    with pytest.raises(InvalidValueError, match="row 2, column 'completion'"):
        texts(path, project)
    assert csv.field_size_limit() == 131_072


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("answers.txt", "a", "texts = .*must be a file that ends in"),
        ("answers.jsonl", "", "texts = .*at least one row"),
        ("answers.jsonl", "{", "row 1 = '{': must be JSON"),
        ("answers.jsonl", '{"completion": "b"}', "column of prompts = 'none': must be one called prompt"),
        ("answers.jsonl", '{"prompt": "b"}', "column of completions = 'none'"),
        ("answers.jsonl", '{"chosen": "b", "rejected": "c"}', "'b': must be beside a column of prompts"),
        ("answers.csv", "prompt,completion\na\n", "row 1 = 'a': must be 2 cells"),
    ],
)
def test_files_that_are_none_are_refused(tmp_path, project, name, content, message):
    (tmp_path / name).write_text(content)
    with pytest.raises(InvalidValueError, match=message):
        texts(tmp_path / name, project)


def test_a_file_that_is_not_there(tmp_path, project):
    with pytest.raises(InvalidValueError, match=r"texts = .*No such file"):
        texts(tmp_path / "none.jsonl", project)


# pairs


def added(project, items):
    with project.store() as store:
        store.add_items(items)
    return items


def clip(i):
    return clip_item(f"{i:064x}.webp", 2, 2, (200, 200), stratum="ab"[i % 2])


def test_only_completions_of_one_prompt_are_paired(project):
    items = added(project, [text_item(f"p{i // 3}", f"c{i}") for i in range(6)] + [text_item("alone", "c")])
    found = pairs(items, project)
    prompts = {item.id: item.content["prompt"] for item in items}
    assert len(found) == len(set(found)) == 6
    assert all(prompts[p.content["left"]] == prompts[p.content["right"]] for p in found)
    assert pairs(items, project, count=100) == found


def test_each_clip_is_in_about_as_many_pairs_as_the_others(project):
    items = added(project, [clip(i) for i in range(20)])
    found = pairs(items, project, count=50, seed=3)
    assert len(set(found)) == 50
    often = Counter(name for p in found for name in (p.content["left"], p.content["right"]))
    assert set(often.values()) <= set(range(3, 8))
    assert {p.stratum for p in found} == {"a", "b", "a | b"}
    assert pairs(items, project, count=50, seed=3) == found
    assert pairs(items, project, count=189, seed=3)[-1] != found[-1]
    with project.store() as store:
        assert len(store.items()[0]) >= 20 + 189


def test_what_cannot_be_paired_is_refused(project):
    with pytest.raises(InvalidValueError, match="items = '2 items': must be at least two clips"):
        pairs([text_item("a", "b"), text_item("c", "d")], project)
    with pytest.raises(InvalidValueError, match="count = 0"):
        pairs([clip(0), clip(1)], project, count=0)
