"""The long table, and the files that are made of it."""

import csv
import io
import json

import numpy as np
import pytest

from uard._checks import InvalidValueError, UnknownNameError
from uard.ratings import export, preferences, readers
from uard.ratings.table import Answer, Answers, answer_of

ITEMS = {
    "x": {"kind": "text", "prompt": "Say hi", "completion": "hi", "reward": 1.0, "stratum": "old"},
    "y": {"kind": "text", "prompt": "Say hi", "completion": "=cmd|' /C calc'!A0", "reward": 0.5, "stratum": "new"},
}


def rated(name, item, rater, value, **more):
    return Answer(name, item, rater, value, scale="slider -1..1", given_at=1e9 + len(name), **more)


def pair(name, rater, choice, left="x", right="y"):
    return Answer(name, "x|y", rater, choice=choice, left=left, right=right, scale="pair")


SAID = Answers((
    rated("a1", "x", "ann", 0.25),
    rated("a2", "y", "ann", 0.5),
    rated("a3", "x", "bob", -1.0),
    rated("a44", "x", "ann", 0.75, kind="repeat"),
    rated("a5", "y", "bob", 1.0, kind="practice"),
    rated("a6", "y", "bob", 0.125),
    Answer("a7", "y", "bob", supersedes="a6"),
    rated("a8", "x", "bob", -0.5, supersedes="a3"),
))  # fmt: skip


def test_the_answers_that_stand():
    assert [a.id for a in SAID.standing()] == ["a1", "a2", "a44", "a5", "a8"]
    assert SAID.raters == ("ann", "bob")


def test_a_log_has_the_latest_rating_and_keeps_the_earlier_ones():
    log = SAID.to_log(lambda item: ITEMS[item]["reward"])
    assert log.raters == ("ann", "bob")
    assert log.item.tolist() == ["x", "y"]
    np.testing.assert_array_equal(log.ratings, [[0.75, -0.5], [0.5, np.nan]])
    np.testing.assert_array_equal(log.reward, [1.0, 0.5])
    assert [x.tolist() for x in log.repeats] == [[0], [0], [0.25]]
    assert SAID.to_log(lambda _: None).reward is None
    with pytest.raises(InvalidValueError, match="at least one rating"):
        Answers((SAID.rows[4],)).to_log(lambda _: None)


@pytest.mark.parametrize("form", ["csv", "jsonl", "parquet"])
def test_the_readers_read_what_is_written(form, tmp_path):
    file = tmp_path / f"answers.{form}"
    file.write_bytes(export.write(SAID, ITEMS, form))
    log = readers.read(file)
    assert log.raters == ("ann", "bob")
    np.testing.assert_array_equal(log.ratings, [[0.75, -0.5], [0.5, np.nan]])
    np.testing.assert_array_equal(log.reward, [1.0, 0.5])
    assert log.repeats is not None


@pytest.mark.parametrize("form", ["csv", "jsonl", "parquet"])
def test_pairs_are_read_as_they_are_written(form, tmp_path):
    said = Answers((pair("p1", "ann", "left"), pair("p2", "bob", "right", "y", "x"), pair("p3", "cyd", "tie")))
    said = Answers((*said.rows, pair("p4", "dan", "cannot tell")))
    file = tmp_path / f"pairs.{form}"
    file.write_bytes(export.write(said, ITEMS, form))
    found = preferences.read(file)
    assert found.outcome.tolist() == [1.0, 1.0, 0.5]
    assert (found.skipped, found.swapped) == (1, 1)


def test_rows_of_preferences_for_trl():
    said = Answers((pair("p1", "ann", "left"), pair("p2", "bob", "right"), pair("p3", "cyd", "tie")))
    rows = [json.loads(line) for line in export.write(said, ITEMS, "trl").splitlines()]
    assert rows[0] == {"prompt": "Say hi", "chosen": "hi", "rejected": ITEMS["y"]["completion"], "rater": "ann"}
    assert (rows[1]["chosen"], len(rows)) == (ITEMS["y"]["completion"], 2)
    with pytest.raises(InvalidValueError, match="there are no comparisons"):
        export.write(SAID, ITEMS, "trl")
    with pytest.raises(InvalidValueError, match="TRL's rows hold texts"):
        export.write(said, {"x": {"kind": "clip"}, "y": {"kind": "clip"}}, "trl")


def test_label_studio_reads_and_we_read_it_back(tmp_path):
    file = tmp_path / "tasks.json"
    file.write_bytes(export.write(SAID, ITEMS, "label-studio"))
    tasks = json.loads(file.read_text())
    assert [t["data"]["item"] for t in tasks] == ["x", "y"]
    log = readers.read(file)
    assert log.raters == ("ann", "bob")
    np.testing.assert_array_equal(log.ratings, [[0.75, -0.5], [0.5, np.nan]])


def test_attributes_are_columns_of_the_same_row():
    more = Answer("b1.1", "x", "ann", 1.0, attribute="safe", given_at=5.0)
    said = Answers((Answer("b1", "x", "ann", 0.5, given_at=5.0), more))
    (row,) = export.rows_of(said, ITEMS)
    assert (row["rating"], row["safe"]) == (0.5, 1.0)
    assert said.to_log(lambda _: None, "safe").ratings.tolist() == [[1.0]]
    (task,) = json.loads(export.write(said, ITEMS, "label-studio"))
    assert [r["from_name"] for r in task["annotations"][0]["result"]] == ["rating", "safe"]


def test_the_record_holds_all_of_it_to_the_bit():
    data = export.write(SAID, ITEMS, "record")
    assert export.read_record(data) == SAID
    assert export.write(export.read_record(data), {}, "record") == data
    with pytest.raises(InvalidValueError, match="line 1 = 'no'"):
        export.read_record(b"no\n")


def test_no_cell_of_a_csv_file_is_a_formula():
    said = Answers((rated("c1", "x", "=1+1", 0.5, comment="@SUM(A1)"),))
    (row,) = csv.DictReader(io.StringIO(export.write(said, ITEMS, "csv").decode()))
    assert (row["rater"], row["comment"], row["rating"]) == ("'=1+1", "'@SUM(A1)", "0.5")


def test_thumbs_are_ratings_with_what_they_are_worth(tmp_path):
    said = Answers((Answer("t1", "x", "ann", 2.0, "up"), Answer("t2", "y", "ann", -1.0, "down")))
    assert said.to_log(lambda _: None).ratings.tolist() == [[2.0], [-1.0]]
    file = tmp_path / "thumbs.csv"
    file.write_bytes(export.write(said, ITEMS, "csv"))
    assert readers.read(file).ratings.tolist() == [[2.0], [-1.0]]
    assert export.read_record(export.write(said, {}, "record")) == said


def test_a_record_keeps_every_character_of_a_comment():
    said = Answers((rated("c1", "x", "ann", 0.5, comment="one\u2028two\u0085three\x0bfour\r\nfive"),))
    assert export.read_record(export.write(said, {}, "record")) == said


def test_half_an_emoji_in_an_old_store_does_not_stop_an_export():
    items = {"x": {"kind": "text", "prompt": "p", "completion": "\ud800", "stratum": "\ud83d"}}
    said = Answers((rated("c1", "x", "ann", 0.5), rated("c2", "x", "bob", 0.5)))
    for form in ("csv", "jsonl", "parquet", "label-studio", "record"):
        assert export.write(said, items, form)


def test_a_record_with_half_an_emoji_is_read_back_as_it_was():
    said = Answers((rated("c1", "x", "ann", 0.5, comment="\ud83d and \n\x00"),))
    assert export.read_record(export.write(said, {}, "record")) == said


def test_strata_of_an_old_store_are_cells_that_can_be_read(tmp_path):
    items = {"x": {"stratum": "\x00\n" + "m" * 1_000_000}, "y": {"stratum": "\ud800"}}
    said = Answers((rated("c1", "x", "ann", 0.5), rated("c2", "y", "ann", 0.5)))
    for form in ("csv", "jsonl", "parquet"):
        path = tmp_path / f"said.{form}"
        path.write_bytes(export.write(said, items, form))
        assert readers.read(path).ratings.shape == (2, 1)
    assert all(len(row["stratum"]) <= 200 for row in export.rows_of(said, items))


@pytest.mark.parametrize("name", ["reward", "item", "rating", "id", "kind", "Worker", "updated_at"])
def test_an_attribute_of_an_old_store_destroys_no_column(name):
    said = Answers((rated("a1", "x", "ann", 0.25), rated("a1.1", "x", "ann", 0.5, attribute=name)))
    (row,), (plain,) = export.rows_of(said, ITEMS), export.rows_of(Answers(said.rows[:1]), ITEMS)
    assert row == plain | {f"rated {name}": 0.5}


def test_no_head_of_a_column_is_a_formula():
    said = Answers((rated("a1", "x", "ann", 0.25), rated("a1.1", "x", "ann", 0.5, attribute='=HYPERLINK("x")')))
    assert next(csv.reader(io.StringIO(export.write(said, ITEMS, "csv").decode())))[-5] == '\'=HYPERLINK("x")'


def test_of_what_was_given_in_one_go_and_corrected_in_part_there_is_one_row():
    said = Answers((
        rated("a1", "x", "ann", 0.25), rated("a1.1", "x", "ann", 0.5, attribute="safe"),
        rated("b1", "x", "ann", -1.0, supersedes="a1"),
        rated("c1", "y", "ann", 0.25), rated("c1.1", "y", "ann", 0.5, attribute="safe"),
        rated("d1", "y", "ann", 0.75, supersedes="c1"),
        rated("d1.1", "y", "ann", 1.0, supersedes="c1.1", attribute="safe"),
    ))  # fmt: skip
    rows = export.rows_of(said, ITEMS)
    assert [(r["id"], r["rating"], r["safe"]) for r in rows] == [("b1", -1.0, 0.5), ("d1", 0.75, 1.0)]
    for task in json.loads(export.write(said, ITEMS, "label-studio")):
        (mark,) = task["annotations"]
        assert len(mark["result"]) == 2


def test_the_latest_time_can_be_written():
    said = Answers((rated("a1", "x", "ann", 0.25), Answer("a2", "x", "ann", 1.0, given_at=253_402_300_799.0)))
    assert export.rows_of(said, ITEMS)[1]["given_at"] == "9999-12-31T23:59:59+00:00"


def test_a_part_of_what_was_given_in_one_go_keeps_its_name():
    main = Answer("b1", "x", "ann", 0.5)
    part = Answer("b1.1", "x", "ann", 1.0, attribute="safe")
    said = Answers((main, part, Answer("o1", "x", "ann", supersedes="b1")))
    (row,) = export.rows_of(said, ITEMS)
    assert (row["id"], row["safe"]) == ("b1", 1.0)


def test_nothing_to_export_is_an_empty_table():
    assert export.write(Answers(), {}, "csv").count(b"\n") == 1
    assert export.write(Answers(), {}, "jsonl") == b""
    with pytest.raises(UnknownNameError, match="did you mean 'parquet'"):
        export.write(SAID, ITEMS, "parqet")


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"id": ""}, "id = ''"),
        ({"rater": "a\nb"}, "rater"),
        ({"value": float("nan")}, "value = nan"),
        ({"value": None}, "value = None"),
        ({"choice": "left", "value": None}, "left, right"),
        ({"choice": "best", "value": None}, "choice = 'best'"),
        ({"choice": "skip"}, "None where the choice is 'skip'"),
        ({"kind": "test"}, "kind = 'test'"),
        ({"given_at": -1.0}, "given_at"),
        ({"given_at": 1e12}, "given_at"),
        ({"comment": "x" * 2001}, "comment"),
    ],
)
def test_bad_answers_are_refused_by_name(fields, message):
    with pytest.raises(InvalidValueError, match=message):
        Answer(**{"id": "a", "item": "x", "rater": "ann", "value": 1.0} | fields)


def test_a_row_without_a_rater_is_no_answer():
    with pytest.raises(InvalidValueError, match="rater = None"):
        answer_of({"id": "a", "item": "x", "value": 1})
