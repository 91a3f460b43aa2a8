import decimal
import fractions
import json
import subprocess
import sys

import gymnasium
import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

import uard.envs  # noqa: F401  (registers ids)
from uard import InvalidValueError, RatingLog, doctor
from uard.diagnosis import filtered
from uard.ratings import preferences
from uard.ratings import readers as logs
from uard.ratings.readers import csv_file
from uard.ratings.rollout import rollout

NAMES = ("reward", "rating_ann", "rating_bob", "sigma_m", "true_reward", "episode", "other")
ROWS = [
    dict(zip(NAMES, row, strict=True))
    for row in (
        (1.0, 0.5, None, 0.1, 1.0, 0, "x"),
        (-2.5, None, 4.0, 0.2, 0.0, 0, "y"),
        (3.0, 1.0, 2.0, 0.3, None, 1, ""),
    )
]


def write_csv(path, separator=",", missing="", encoding="utf-8"):
    lines = [separator.join(ROWS[0])]
    lines += [separator.join(missing if x is None else str(x) for x in row.values()) for row in ROWS]
    path.write_text("\n".join(lines) + "\n", encoding=encoding)


def write_jsonl(path):
    path.write_text("".join(json.dumps(row) + "\n" for row in ROWS))


def write_lists(path):
    rows = [{"reward": r["reward"], "ratings": [r["rating_ann"], r["rating_bob"]]} for r in ROWS]
    path.write_text("\n\n".join(json.dumps(row) for row in rows))


def write_parquet(path):
    parquet.write_table(pa.Table.from_pylist(ROWS), path)


def write_parquet_lists(path):
    rows = [{"reward": r["reward"], "ratings": [r["rating_ann"], r["rating_bob"]]} for r in ROWS]
    parquet.write_table(pa.Table.from_pylist(rows), path)


@pytest.mark.parametrize(
    ("name", "write"),
    [
        ("log.csv", write_csv),
        ("log.CSV", lambda p: write_csv(p, ";", "NA")),
        ("log.tsv", lambda p: write_csv(p, "\t", "None")),
        ("bom.csv", lambda p: write_csv(p, encoding="utf-8-sig")),
        ("log.jsonl", write_jsonl),
        ("lists.ndjson", write_lists),
        ("log.parquet", write_parquet),
        ("lists.pq", write_parquet_lists),
    ],
)
def test_formats_agree(tmp_path, name, write):
    write(tmp_path / name)
    log = logs.read(tmp_path / name)
    assert log.reward.tolist() == [1.0, -2.5, 3.0]
    assert np.array_equal(log.ratings, [[0.5, np.nan], [np.nan, 4.0], [1.0, 2.0]], equal_nan=True)
    if name.startswith("lists"):
        assert log.raters == ("ratings[0]", "ratings[1]")
    else:
        assert log.raters == ("rating_ann", "rating_bob")
        assert log.sigma_m.tolist() == [0.1, 0.2, 0.3]
        assert np.array_equal(log.true_reward, [1.0, 0.0, np.nan], equal_nan=True)
        assert log.place(2) == "row 3 (episode 1)"
        assert (log.item, log.step) == (None, None)


def test_columns_by_name(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("score,alice,bob,rating_old\n1,2,3,4\n5,6,7,8\n")
    log = logs.read(path, "score", ["bob", "alice"])
    assert (log.reward.tolist(), log.ratings.tolist(), log.raters) == ([1, 5], [[3, 2], [7, 6]], ("bob", "alice"))


def test_columns_in_memory():
    log = logs.from_columns(
        {"reward": (1, 2), "rating_1": np.array([0.5, np.nan]), "rating_2": [None, 3], "x": ["?", 0]}
    )
    assert np.array_equal(log.ratings, [[0.5, np.nan], [np.nan, 3.0]], equal_nan=True)


def test_infinity_and_nan_are_read_as_they_are(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("reward,rating\ninf,-Infinity\nnan,1\n,n/a\n")
    log = logs.read(path)
    assert np.array_equal(log.reward, [np.inf, np.nan, np.nan], equal_nan=True)
    assert np.array_equal(log.ratings[:, 0], [-np.inf, 1.0, np.nan], equal_nan=True)


def test_chunks_keep_their_row_numbers(tmp_path, monkeypatch):
    monkeypatch.setattr(csv_file, "_CHUNK", 10)
    path = tmp_path / "log.csv"
    lines = [f"{i},{i},e{i // 7}" for i in range(95)]
    path.write_text("reward,rating,episode\n" + "\n".join(lines))
    log = logs.read(path)
    assert log.reward.tolist() == list(range(95))
    assert log.place(94) == "row 95 (episode e13)"
    lines[57] = "57,oops,e0"
    path.write_text("reward,rating,episode\n" + "\n".join(lines))
    with pytest.raises(InvalidValueError, match="row 58, column 'rating' = 'oops'"):
        logs.read(path)


BAD_TEXT = [
    ("csv", "", "a CSV file whose first line names its columns"),
    ("csv", "\n\n", "a CSV file whose first line names its columns"),
    ("csv", "reward,rating_1\n", "a log with at least one row"),
    ("csv", "reward,rating_1\n1,2\n3,four\n", "row 2, column 'rating_1' = 'four': must be a number, or nothing"),
    ("csv", "reward,rating_1\n1,2\n3\n", "row 2 = '3': must be 2 cells, as the header has"),
    ("csv", "reward,rating_1\n1,2,3\n", "row 1 = '1,2,3': must be 2 cells"),
    ("csv", "reward,sigma_m\n1,2\n", "columns that start with = 'rating': must be there; name them with ratings"),
    ("csv", "reward,sigma_m\n1,2\n", "Columns: reward, sigma_m"),
    ("csv", "rewards,rating_1\n1,2\n", "column = 'reward': must be one of rating_1, rewards (did you mean 'rewards'?)"),
    ("csv", "reward,rating_1,rating_1\n1,2,3\n", "column = 'rating_1': must be there only once"),
    ("csv", "reward,rating_1,sigma_m\n1,2,0\n1,2,-0.5\n", "row 2, column 'sigma_m' = -0.5: must be a number >= 0"),
    ("csv", "reward\0,rating_1\n1,2\n", "text, not binary data"),
    ("jsonl", "", "a JSON file with at least one row"),
    ("jsonl", '{"reward": 1, "rating": 1}\n{"reward": 1,', "row 2 = '{\"reward\": 1,': must be JSON"),
    ("jsonl", "[1, 2]\n", "row 1 = [1, 2]: must be a JSON object"),
    ("jsonl", '{"reward": 1, "rating": 1}\n{"rewrd": 1}', "row 2, column = 'reward': must be one of rating, rewrd"),
    ("jsonl", '{"reward": 1, "rating": 1}\n{"reward": 1, "rating": "1"}', "row 2, column 'rating' = '1': must be"),
    ("jsonl", '{"reward": 1, "rating": true}', "row 1, column 'rating' = True: must be a number"),
    ("jsonl", '{"reward": 1, "ratings": [1, {"a": 2}]}', "row 1, column 'ratings[1]' = {'a': 2}: must be a number"),
    ("jsonl", '{"reward": 1' + "0" * 400 + ', "rating": 1}', "row 1, column 'reward' = 1000"),
    ("jsonl", '{"reward": 1, "note": 2}', "Columns: reward, note"),
    ("parquet", "this is no Parquet", "must be a Parquet file"),
    ("txt", "reward,rating\n1,2", "a file that ends in .csv, .tsv, .jsonl"),
]  # fmt: skip


@pytest.mark.parametrize(("suffix", "text", "message"), BAD_TEXT)
def test_bad_files(tmp_path, suffix, text, message):
    path = tmp_path / f"log.{suffix}"
    path.write_text(text)
    with pytest.raises(InvalidValueError) as error:
        logs.read(path)
    assert message in str(error.value)
    assert str(path) in str(error.value)


@pytest.mark.parametrize("suffix", ["csv", "jsonl", "parquet"])
def test_garbage(tmp_path, suffix):
    path = tmp_path / f"log.{suffix}"
    for data in (np.random.default_rng(0).bytes(5000), "reward,rating\n1,é".encode("latin-1"), b"\xff\xfe\x00"):
        path.write_bytes(data)
        with pytest.raises(InvalidValueError, match="log"):
            logs.read(path)
    path.unlink()
    with pytest.raises(InvalidValueError, match=r"a file that can be read \(No such file"):
        logs.read(path)
    path.mkdir()
    with pytest.raises(InvalidValueError, match="must be a"):
        logs.read(path)


def test_a_column_of_text_in_parquet(tmp_path):
    parquet.write_table(pa.table({"reward": [1.0], "rating_a": ["1"]}), tmp_path / "log.parquet")
    with pytest.raises(InvalidValueError, match="column 'rating_a' = 'string': must be a column of numbers"):
        logs.read(tmp_path / "log.parquet")
    parquet.write_table(pa.table({"score": [1.0], "rating_a": [1]}), tmp_path / "log.parquet")
    assert logs.read(tmp_path / "log.parquet").reward is None
    parquet.write_table(pa.table({"rewards": [1.0], "rating_a": [1]}), tmp_path / "log.parquet")
    with pytest.raises(InvalidValueError, match="column = 'reward': must be one of rating_a, rewards"):
        logs.read(tmp_path / "log.parquet")


def test_parquet_without_pyarrow_names_the_extra(tmp_path):
    write_parquet(tmp_path / "log.parquet")
    code = (
        "import sys; sys.modules['pyarrow'] = None\n"
        "from uard import doctor\n"
        "try: doctor(sys.argv[1])\n"
        "except ValueError as error: print(error)"
    )
    command = [sys.executable, "-c", code, str(tmp_path / "log.parquet")]
    assert "pip install 'uard[doctor]'" in subprocess.run(command, capture_output=True, text=True, check=True).stdout


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"reward": np.zeros(0)}, "reward.shape"),
        ({"reward": np.zeros((3, 1))}, "reward.shape"),
        ({"ratings": np.zeros((2, 2))}, "ratings.shape = (2, 2): must be (3, K)"),
        ({"raters": ("a",)}, "raters = ('a',): must be 2 names"),
        ({"sigma_m": np.zeros(2)}, "sigma_m.shape = (2,): must be (3,)"),
        ({"sigma_m": np.array([0, -1, 0])}, "row 2, column 'sigma_m' = -1.0"),
        ({"true_reward": ["a", "b", "c"]}, "true_reward"),
        ({"item": np.zeros((3, 2))}, "item.shape"),
    ],
)
def test_bad_arrays(changes, message):
    with pytest.raises(InvalidValueError) as error:
        RatingLog(**({"reward": np.zeros(3), "ratings": np.zeros((3, 2))} | changes))
    assert message in str(error.value)


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"reward": [1, 2], "rating_1": [1]}, "column 'rating_1' = '1 rows': must be of 2 rows, like 'reward'"),
        ({"reward": [1, 2]}, "Columns: reward"),
        ({"reward": [1, "2"], "rating": [1, 1]}, "row 2, column 'reward' = '2'"),
        ({"reward": [], "rating": []}, "at least one row"),
    ],
)
def test_bad_columns(columns, message):
    with pytest.raises(InvalidValueError) as error:
        logs.from_columns(columns)
    assert message in str(error.value)


def test_rollouts_are_seeded_and_read_info():
    with gymnasium.make("uard/TrapGrid6-v0", panel="main") as env:
        a, b, c = (rollout(env, 100, seed) for seed in (0, 0, 1))
    assert np.array_equal(a.ratings, b.ratings)
    assert a.reward.tolist() == b.reward.tolist()
    assert not np.array_equal(a.ratings, c.ratings)
    assert a.ratings.shape == (100, 3)
    trap = a.reward == 4.0
    assert (a.true_reward[~trap] == a.reward[~trap]).all()
    assert a.place(41) == "row 42 (episode 1, step 1)"
    assert a.item[0].startswith("state 0, action ")
    assert a.source == "uard/TrapGrid6-v0, 100 random steps, seed 0"


def test_an_environment_without_ratings():
    with gymnasium.make("CartPole-v1") as env:
        log = rollout(env, 30)
    assert log.ratings.shape == (30, 0)
    assert (log.true_reward, log.item, log.sigma_m) == (None, None, None)


class Moody(gymnasium.Env):
    """Rates as it likes: a list of what info holds, step by step."""

    action_space = gymnasium.spaces.Discrete(2)
    observation_space = gymnasium.spaces.Discrete(2)

    def __init__(self, infos):
        self.infos = list(infos)

    def reset(self, *, seed=None, options=None):
        return 0, {}

    def step(self, action):
        return 0, 0.0, False, False, self.infos.pop(0)


@pytest.mark.parametrize(
    ("infos", "message"),
    [
        ([{"ratings": [1, 2]}, {}], "rollout: row 2, column 'ratings' = None: must be in info at every step"),
        ([{}, {"ratings": [1, 2]}], "rollout: row 2, column 'ratings' = [1, 2]: must be in info at every step"),
        ([{"ratings": [1, 2]}, {"ratings": [1]}], "rollout: row 2, column 'ratings' = [1]: must be a row of K ratings"),
        ([{"ratings": 3}, {"ratings": 3}], "rollout: row 1, column 'ratings' = 3: must be a row of K ratings"),
    ],
)
def test_a_rollout_whose_ratings_change(infos, message):
    with pytest.raises(InvalidValueError) as error:
        rollout(Moody(infos), 2)
    assert message in str(error.value)


# Long logs, and what annotation tools export


LONG = """item,annotator,rating,reward,created_at
clip-1,ann-a,0.9,1.0,2026-10-01T09:00:00Z
clip-2,ann-b,0.2,0.2,2026-10-01T09:02:30Z
clip-2,ann-a,0.4,0.2,2026-10-01T09:30:00Z
clip-1,ann-b,1.0,1.0,2026-10-01T09:01:00Z
clip-2,ann-a,0.1,0.2,2026-10-01T11:00:00+02:00
clip-3,ann-b,NA,0.7,2026-10-01T09:31:00Z
"""


def test_a_long_log_becomes_a_row_per_item_and_the_later_answer_counts(tmp_path):
    """Nine o'clock UTC is eleven in summer time, so ann-a's answer in the fifth row is before that in the third."""
    (tmp_path / "log.csv").write_text(LONG)
    log = logs.read(tmp_path / "log.csv")
    assert log.raters == ("ann-a", "ann-b")
    assert log.item.tolist() == ["clip-1", "clip-2", "clip-3"]
    assert log.reward.tolist() == [1.0, 0.2, 0.7]
    assert np.array_equal(log.ratings, [[0.9, 1.0], [0.4, 0.2], [np.nan, np.nan]], equal_nan=True)
    assert [x.tolist() for x in log.repeats] == [[1], [0], [0.1]]
    assert log.place(1) == "row 2 (item clip-2)"


def test_without_times_the_last_answer_counts_and_earlier_ones_keep_their_order():
    columns = {"task": list("aaab"), "worker": [7, 7, 7.0, 8], "label": [1, 2, 3, 4]}
    log = logs.from_columns(columns)
    assert (log.reward, log.raters) == (None, ("7", "8"))
    assert np.array_equal(log.ratings, [[3.0, np.nan], [np.nan, 4.0]], equal_nan=True)
    assert [x.tolist() for x in log.repeats] == [[0, 0], [0, 0], [1.0, 2.0]]


@pytest.mark.parametrize(
    ("names", "rows"),
    [
        ("item annotator rating", ""),
        ("Item ID;Annotator_ID;Rating", ""),
        ("task,worker,label", ""),
        ("instance_id\tuser\tscore", ""),
        ("id,completed_by,value", ""),
        ("id,item,Rater,response,rating_of_clip", "9,"),  # `id` is no item where there is another
    ],
)
def test_the_usual_names(tmp_path, names, rows):
    separator = next(s for s in (",", ";", "\t", " ") if s in names)
    lines = [names, *(rows + separator.join(x) for x in (("a", "ann", "1"), ("a", "bob", "2"), ("b", "bob", "3")))]
    if "response" in names:
        lines = [names, "9,a,ann,so,1", "8,a,bob,yes,2", "7,b,bob,no,3"]
    (tmp_path / "log.csv").write_text("\n".join(lines).replace(" ", "," if separator == " " else " "))
    log = logs.read(tmp_path / "log.csv")
    assert log.raters == ("ann", "bob")
    assert np.array_equal(log.ratings, [[1, 2], [np.nan, 3]], equal_nan=True)
    assert log.item.tolist() == ["a", "b"]


AMBIGUOUS = {
    "two raters": ("item,user,annotator,rating", "says who rated = 'user, annotator': must be one; name it with rater"),
    "two items": ("item,task,annotator,rating", "says what was rated = 'item, task': must be one; name it with item"),
    "no item": ("clip,annotator,rating", "says what was rated = 'none': must be one; name it with item (--item)"),
    "two ratings": ("item,annotator,score,label", "holds ratings = 'score, label': must be one; name it with rating"),
    "two rating columns": ("item,user,rating_a,rating_b", "holds ratings = 'rating_a, rating_b': must be one;"),
    "no rating": ("item,annotator,quality", "holds ratings = 'none': must be one; name it with rating (--rating)"),
    "twice": ("item,annotator,rating,rating", "column = 'rating': must be there only once"),
}  # fmt: skip


@pytest.mark.parametrize("names", AMBIGUOUS)
def test_where_several_columns_could_be_meant_the_message_names_them_and_the_option(tmp_path, names):
    header, message = AMBIGUOUS[names]
    (tmp_path / "log.csv").write_text(header + "\n1,1,1,1"[: 2 * header.count(",") + 2] + "\n")
    with pytest.raises(InvalidValueError) as error:
        logs.read(tmp_path / "log.csv")
    assert message in str(error.value)


def test_options_decide():
    columns = {
        "item": ["a", "a"],
        "clip": ["x", "y"],
        "user": ["u", "v"],
        "judge": ["j", "k"],
        "score": [1, 2],
        "rating": [3, 4],
    }
    log = logs.from_columns(columns, rater="judge", item="clip", rating="score")
    assert np.array_equal(log.ratings, [[1, np.nan], [np.nan, 2]], equal_nan=True)
    assert (log.raters, log.item.tolist()) == (("j", "k"), ["x", "y"])
    log = logs.from_columns(columns | {"reward": [0, 1]}, ratings=["score", "rating"], item="clip")
    assert (log.raters, log.ratings.tolist(), log.item.tolist()) == (("score", "rating"), [[1, 3], [2, 4]], ["x", "y"])
    with pytest.raises(InvalidValueError, match=r"ratings = .*: must be left out where rater or rating names a column"):
        logs.from_columns(columns, ratings=["score"], rater="user")
    with pytest.raises(InvalidValueError, match=r"column = 'usr': must be one of .* \(did you mean 'user'\?\)"):
        logs.from_columns(columns, rater="usr")


def test_a_column_divides_the_items_of_a_long_log():
    columns = {"item": list("aab"), "rater": list("xyx"), "rating": [1, 2, 3], "system": ["m", "m", "n"]}
    assert logs.from_columns(columns, by="system").by.tolist() == ["m", "n"]
    with pytest.raises(
        InvalidValueError, match=r"item 'a', column 'system' = \('m', 'o'\): must be the same in all rows"
    ):
        logs.from_columns(columns | {"system": list("mon")}, by="system")
    with pytest.raises(InvalidValueError, match="by = 'rating': must be a column that is neither"):
        logs.from_columns(columns, by="rating")
    wide = {"reward": [1, 2], "rating_a": [1, 2], "item": ["a", "b"]}
    assert logs.from_columns(wide, by="item").by.tolist() == ["a", "b"]


BAD_LONG = [
    ({"item": ["a", None], "rater": ["x", "y"], "rating": [1, 2]}, "row 2, column 'item' = None: must be a name"),
    ({"item": ["a", "b"], "rater": ["x", ""], "rating": [1, 2]}, "row 2, column 'rater' = None: must be a name"),
    (
        {"item": ["a", "a"], "rater": ["x", "y"], "rating": [1, 2], "reward": [1.0, 2.0]},
        "log: item 'a', column 'reward' = (1.0, 2.0): must be the same in all rows of an item",
    ),
    (
        {"item": ["a", "a"], "rater": ["x", "x"], "rating": [1, 2], "timestamp": [1, "soon"]},
        "row 2, column 'timestamp' = 'soon': must be a number or a time as in ISO 8601",
    ),
    ({"item": ["a"], "rater": ["x"], "label": ["good"]}, "row 1, column 'label' = 'good': must be a number"),
    ({"item": range(5000), "rater": range(5000), "rating": [1] * 5000}, "5000 items and 5000 raters': must be a table"),
    ({"item": [], "rater": [], "rating": []}, "at least one row"),
]  # fmt: skip


@pytest.mark.parametrize(("columns", "message"), BAD_LONG)
def test_bad_long_logs(columns, message):
    with pytest.raises(InvalidValueError) as error:
        logs.from_columns(columns)
    assert message in str(error.value)


def test_an_answer_that_is_missing_needs_no_rater():
    log = logs.from_columns({"item": ["a", "b"], "rater": ["x", None], "rating": [1, None], "reward": [1, None]})
    assert np.array_equal(log.ratings, [[1], [np.nan]], equal_nan=True)
    assert np.array_equal(log.reward, [1, np.nan], equal_nan=True)


def label_studio():
    def annotation(who, cancelled=False, **answers):
        types = {"quality": "rating", "length": "number", "stars": "choices"}
        result = [
            {"from_name": q, "type": types[q], "value": {types[q]: [v] if q == "stars" else v}}
            for q, v in answers.items()
        ]
        result.append({"from_name": "why", "type": "textarea", "value": {"text": ["so"]}})
        return {"completed_by": who, "was_cancelled": cancelled, "result": result, "updated_at": "2026-10-01T09:00:00Z"}

    first = [annotation(1, quality=5), annotation(2, quality=4)]
    second = [annotation(1, True, quality=1), annotation(2, stars="2")]
    tasks = [
        {"id": 11, "data": {"text": "a", "reward": 4}, "annotations": first},
        {"id": 12, "data": {"text": "b", "reward": 1}, "annotations": second},
    ]
    return tasks, annotation


ARGILLA_2 = [
    {"id": "11", "fields": {"text": "a"}, "metadata": {"reward": 4}, "responses": {"quality": [
        {"value": 5, "user_id": "1", "status": "submitted"}, {"value": "4", "user_id": "2", "status": "submitted"}]}},
    {"id": "12", "fields": {"text": "b"}, "metadata": {"reward": 1}, "responses": {"quality": [
        {"value": 9, "user_id": "1", "status": "discarded"}, {"value": 2, "user_id": "2"}]}},
]  # fmt: skip
ARGILLA_1 = [
    {"id": "11", "metadata": {"reward": 4}, "responses": [
        {"user_id": "1", "values": {"quality": {"value": 5}}, "status": "submitted"},
        {"user_id": "2", "values": {"quality": {"value": 4}}, "status": "submitted"}]},
    {"id": "12", "metadata": {"reward": 1}, "responses": [
        {"user_id": "1", "values": {"quality": {"value": 9}}, "status": "draft"},
        {"user_id": "2", "values": {"quality": {"value": 2}}, "status": "submitted"}]},
]  # fmt: skip
ARGILLA_HUB = [
    {"external_id": "11", "reward": 4, "quality": [{"user_id": "1", "value": 5}, {"user_id": "2", "value": 4}]},
    {"external_id": "12", "reward": 1, "quality": [{"user_id": "2", "value": 2}]},
]
POTATO_CSV = """user,instance_id,displayed_text,quality:::scale_5,quality:::scale_4,quality:::scale_2,reward
1,11,a,5,,,4
2,11,a,,4,,4
2,12,b,,,2,1
"""
POTATO_JSONL = [
    {"user_id": "1", "id": "11", "displayed_text": "a", "label_annotations": {"quality": {"scale_5": "5"}}},
    {"user_id": "2", "id": "11", "displayed_text": "a", "label_annotations": {"quality": {"4": True, "3": False}}},
    {"user_id": "2", "id": "12", "displayed_text": "b", "label_annotations": {"quality": {"2": "true"}}},
]
CROWD_KIT = "task,worker,label\n11,1,5\n11,2,4\n12,2,2\n"


def exports():
    tasks, annotation = label_studio()
    tasks[1]["annotations"][1] = annotation({"id": 2, "first_name": ""}, quality=2)
    lines = ["\n".join(map(json.dumps, x)) for x in (ARGILLA_2, POTATO_JSONL)]
    texts = (json.dumps(tasks), json.dumps(ARGILLA_2), json.dumps(ARGILLA_1), json.dumps(ARGILLA_HUB))
    return {
        **dict(zip(("label_studio.json", "argilla_2.json", "argilla_1.json", "argilla_hub.json"), texts, strict=True)),
        "argilla.jsonl": lines[0],
        "potato.jsonl": lines[1],
        "potato.csv": POTATO_CSV,
        "potato.tsv": POTATO_CSV.replace(",", "\t"),
        "crowd_kit.csv": CROWD_KIT,
    }


@pytest.mark.parametrize("name", exports())
def test_exports_of_annotation_tools_agree(tmp_path, name):
    (tmp_path / name).write_text(exports()[name])
    log = logs.read(tmp_path / name)
    assert (log.raters, log.item.tolist()) == (("1", "2"), ["11", "12"])
    assert np.array_equal(log.ratings, [[5, 4], [np.nan, 2]], equal_nan=True)
    if "crowd" in name or name == "potato.jsonl":
        assert log.reward is None
    else:
        assert log.reward.tolist() == [4, 1]


def test_questions_of_tools_are_chosen_by_name(tmp_path):
    path = tmp_path / "export.json"
    tasks, annotation = label_studio()
    path.write_text(json.dumps(tasks))
    with pytest.raises(InvalidValueError, match=r"holds ratings = 'quality, stars': must be one; name it with rating"):
        logs.read(path)
    assert np.array_equal(logs.read(path, rating="stars").ratings, [[np.nan], [2]], equal_nan=True)
    for answers, message in (
        ({"quality": [1, 2]}, "task 11, quality = [1, 2]: must be one answer per annotation"),
        ({"quality": "good"}, "column 'quality' = 'good': must be a number"),
    ):
        tasks[0]["annotations"] = [annotation(1, **answers)]
        path.write_text(json.dumps(tasks))
        with pytest.raises(InvalidValueError) as error:
            logs.read(path, rating="quality")
        assert message in str(error.value)


def test_an_export_without_answers_and_a_log_whose_columns_only_look_like_one(tmp_path):
    path = tmp_path / "export.json"
    for entry in ({"id": 1, "data": {}, "annotations": []}, {"id": 1, "fields": {}, "responses": {}}):
        path.write_text(json.dumps([entry]))
        with pytest.raises(InvalidValueError, match="must be an export with at least one answer"):
            logs.read(path)
    path.write_text(json.dumps([{"responses": ["yes", "no"], "fields": 3, "reward": 1, "rating": 2}]))
    assert logs.read(path).ratings.tolist() == [[2.0]]


def test_one_user_of_potato(tmp_path):
    """The 1.x lines of one user do not name the user, who is in the folder's name; those of all users are refused."""
    line = '{"id": "11", "displayed_text": "a", "label_annotations": {"quality": {"scale_5": "5"}}}\n'
    for folder in ("annotation_output/ann", "annotation_output"):
        (tmp_path / folder).mkdir(parents=True, exist_ok=True)
        (tmp_path / folder / "annotated_instances.jsonl").write_text(line)
    assert logs.read(tmp_path / "annotation_output/ann/annotated_instances.jsonl").raters == ("ann",)
    with pytest.raises(InvalidValueError, match="potato's CSV or TSV"):
        logs.read(tmp_path / "annotation_output/annotated_instances.jsonl")
    state = {"user_id": "bob", "instance_id_to_label_to_value": {"11": {"quality": {"labels": {"4": True}}}}}
    (tmp_path / "user_state.json").write_text(json.dumps(state))
    log = logs.read(tmp_path / "user_state.json")
    assert (log.raters, log.item.tolist(), log.ratings.tolist()) == (("bob",), ["11"], [[4.0]])
    (tmp_path / "two.csv").write_text("user,instance_id,q:::a,q:::b\nann,1,1,2\n")
    with pytest.raises(InvalidValueError, match=r"row 1 = \{'a': '1', 'b': '2'\}: must be one label per question"):
        logs.read(tmp_path / "two.csv")


PLACEHOLDERS = "item,reward,rating_1,rating_2\na,1,?,x\nb,2,?,2\nc,3,-,N/A\nd,4,4,<NA>\n"


def test_placeholders_are_named_all_at_once_and_can_be_declared(tmp_path):
    (tmp_path / "log.csv").write_text(PLACEHOLDERS)
    with pytest.raises(InvalidValueError) as error:
        logs.read(tmp_path / "log.csv")
    assert "the first in row 1, by column, with counts = {'rating_1': {'?': 2}, 'rating_2': {'x': 1}}" in str(
        error.value
    )
    assert "missing=('?',) or --missing '?'" in str(error.value)
    expected = [[np.nan, np.nan], [np.nan, 2], [np.nan, np.nan], [4, np.nan]]
    assert np.array_equal(logs.read(tmp_path / "log.csv", missing=("?", "X")).ratings, expected, equal_nan=True)
    with pytest.raises(InvalidValueError, match=r"missing = '\?': must be several texts"):
        logs.read(tmp_path / "log.csv", missing="?")
    text = {"reward": [1, 2], "rating": ["?", 2]}
    assert np.array_equal(logs.from_columns(text, missing=["?"]).ratings, [[np.nan], [2]], equal_nan=True)


def test_a_number_that_means_missing_does_so_among_ratings_alone(tmp_path):
    """In a file too, whatever else is in the column."""
    (tmp_path / "log.csv").write_text("reward,rating\n0,0\nn/a,n/a\n0,3\n")
    log = logs.read(tmp_path / "log.csv", missing=["0"])
    assert np.array_equal(log.reward, [0, np.nan, 0], equal_nan=True)
    assert np.array_equal(log.ratings[:, 0], [np.nan, np.nan, 3], equal_nan=True)
    log = logs.from_columns({"reward": [0, -1], "rating_a": [0, 3], "rating_b": [2, -1]}, missing=("0", "-1.0"))
    assert log.reward.tolist() == [0, -1]
    assert np.array_equal(log.ratings, [[np.nan, 2], [3, np.nan]], equal_nan=True)


@pytest.mark.parametrize("cell", ["1_000", "٣", "0x10", "1,5", "４"])
def test_numbers_are_plain_decimals(tmp_path, cell):
    path = tmp_path / "log.csv"
    path.write_text(f"reward;rating\n1;2\n1;{cell}\n", encoding="utf-8")
    with pytest.raises(InvalidValueError, match=f"row 2, column 'rating' = '{cell}': must be a number"):
        logs.read(path)


def test_null_beside_lists_is_no_rater(tmp_path):
    path = tmp_path / "log.jsonl"
    path.write_text('{"reward": 1, "ratings": null}\n{"reward": 2, "ratings": [1, 2]}\n{"reward": 3, "ratings": []}\n')
    log = logs.read(path)
    assert log.raters == ("ratings[0]", "ratings[1]")
    assert np.array_equal(log.ratings, [[np.nan, np.nan], [1, 2], [np.nan, np.nan]], equal_nan=True)
    path.write_text('{"reward": 1, "ratings": [1, 2]}\n{"reward": 2, "ratings": 3}\n')
    with pytest.raises(InvalidValueError, match="row 2, column 'ratings' = 3: must be a list, as in other rows"):
        logs.read(path)


BAD_PARQUET = {
    "beyond": ({"reward": [2**53 + 1], "rating": [1]}, "column 'reward' = 'int64': must be numbers that a float"),
    "list": ({"reward": [[1, 2]], "rating": [1]}, "column 'reward' = 'list<"),
    "nested": ({"reward": [1], "ratings": [[[1]]]}, "row 1, column 'ratings[0]' = [1]: must be a number"),
    "truth": ({"reward": [True], "rating": [1]}, "column 'reward' = 'bool': must be a column of numbers"),
}


@pytest.mark.parametrize("name", BAD_PARQUET)
def test_bad_parquet(tmp_path, name):
    columns, message = BAD_PARQUET[name]
    parquet.write_table(pa.table(columns), tmp_path / "log.parquet")
    with pytest.raises(InvalidValueError) as error:
        logs.read(tmp_path / "log.parquet")
    assert message.replace("<", "") in str(error.value).replace("<", "")


def test_parquet_of_answers_decimals_and_doubled_columns(tmp_path):
    path = tmp_path / "log.parquet"
    table = {"task": ["a", "a"], "worker": [1, 2], "label": [decimal.Decimal("1.5"), decimal.Decimal(2)]}
    parquet.write_table(pa.table(table), path)
    assert logs.read(path).ratings.tolist() == [[1.5, 2.0]]
    doubled = pa.Table.from_arrays([pa.array([1.0])] * 3, ["reward", "rating", "rating"])
    parquet.write_table(doubled, path)
    with pytest.raises(InvalidValueError, match="column = 'rating': must be there only once"):
        logs.read(path)
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(InvalidValueError, match="must be a Parquet file"):
        logs.read(path)


class Frame:
    """A data frame whose columns may have the same name, as pandas' may."""

    columns = ("reward", "rating", "rating")

    def __getitem__(self, name):
        return [1.0]


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"reward": [1, 2, 3], "rating": "123"}, "column 'rating' = '123': must be a list or an array"),
        ({"reward": [1], "rating": {1: "x"}}, "column 'rating' = {1: 'x'}: must be a list or an array"),
        ({"reward": [1], "rating": 3}, "column 'rating' = 3: must be a list or an array"),
        ({"reward": [1], "rating": {3}}, "column 'rating' = {3}: must be a list or an array"),
        ({"reward": [1], "rating": np.ones((1, 2))}, "column 'rating' = (1, 2): must be of one dimension"),
        ({"reward": [1], "rating": [True]}, "row 1, column 'rating' = True"),
        ({"reward": [1], "rating": np.array([True])}, "row 1, column 'rating' = True"),
        ({"reward": [[1, 2]], "rating": [1]}, "row 1, column 'reward' = [1, 2]"),
        ({"reward": [10**400], "rating": [1]}, "row 1, column 'reward' = 1000"),
        ({"reward": [1j], "rating": [1]}, "row 1, column 'reward' = 1j"),
        ({"reward": [1], 5: [1]}, "name of a column = 5: must be text"),
        ([{"reward": 1, "rating": 1}], "must be named columns"),
        (None, "log = None: must be named columns"),
        (Frame(), "column = 'rating': must be there only once"),
    ],
)
def test_columns_that_are_none(columns, message):
    with pytest.raises(InvalidValueError) as error:
        logs.from_columns(columns)
    assert message in str(error.value)


def test_what_counts_as_a_number_in_memory():
    cells = [decimal.Decimal("0.5"), np.float16(1.5), fractions.Fraction(5, 2), np.int8(3), np.array(4.0), None]
    log = logs.from_columns({"reward": np.arange(6), "rating": cells})
    assert np.array_equal(log.ratings[:, 0], [0.5, 1.5, 2.5, 3, 4, np.nan], equal_nan=True)


@pytest.mark.parametrize("name", ["x" * 300 + ".csv", "a\0b.csv"])
def test_names_that_no_file_can_have(name):
    with pytest.raises(InvalidValueError, match="log = "):
        logs.read(name)


def test_items_may_be_long_texts():
    """One prompt of a megabyte must not make all others as long."""
    log = logs.from_columns({"reward": range(1000), "rating": range(1000), "item": ["x" * 10**6, *range(999)]})
    assert log.item.nbytes <= 8 * 1000


# Answers about pairs


PAIRS = """{"id": "q1", "annotator": "ann", "left": "x", "right": "y", "choice": "left"}
{"id": "q1", "annotator": "bob", "left": "y", "right": "x", "choice": "right"}
{"id": "q1", "annotator": "cat", "left": "x", "right": "y", "choice": "tie"}
{"id": "q2", "annotator": "ann", "left": "z", "right": "y", "choice": "z"}
{"id": "q2", "annotator": "bob", "left": "y", "right": "z", "choice": "Skip"}
"""


def test_pairs_are_turned_one_way(tmp_path):
    """Of x and y three say x, x and tie: one of three pairs of raters agrees; of y and z only one rater speaks."""
    path = tmp_path / "pairs.jsonl"
    path.write_text(PAIRS)
    asked = preferences.read(path)
    assert list(zip(asked.first, asked.second, asked.outcome.tolist(), asked.rater, strict=True)) == [
        ("x", "y", 1.0, "ann"), ("x", "y", 1.0, "bob"), ("x", "y", 0.5, "cat"), ("y", "z", 0.0, "ann"),
    ]  # fmt: skip
    assert (asked.skipped, asked.swapped, asked.raters) == (1, 2, ("ann", "bob", "cat"))
    assert asked.agreement() == pytest.approx(1 / 3)
    with pytest.raises(InvalidValueError, match=r"answers about pairs, which `uard preferences .*pairs.jsonl` and"):
        logs.read(path)


@pytest.mark.parametrize(
    "text",
    [
        "left,right,label\nx,y,x\ny,x,x\n",
        "response_a,response_b,winner\nx,y,A\ny,x,B\n",
        "Response 1;Response 2;preferred\nx;y;1\ny;x;response 2\n",
        "model_a,model_b,winner\nx,y,model_a\ny,x,model_b\n",
        "prompt,chosen,rejected\np,x,y\np,x,y\n",
    ],
)
def test_the_usual_columns_of_pairs(tmp_path, text):
    (tmp_path / "pairs.csv").write_text(text)
    asked = preferences.read(tmp_path / "pairs.csv")
    assert (asked.first.tolist(), asked.outcome.tolist(), asked.rater, asked.agreement()) == (
        ["x", "x"],
        [1, 1],
        None,
        None,
    )
    with pytest.raises(InvalidValueError, match="uard preferences"):
        logs.read(tmp_path / "pairs.csv")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "left,right,choice\nx,y,maybe\nx,y,maybe\nx,y,0\n",
            "with counts = {'maybe': 2, '0': 1}: must be left or right",
        ),
        ("left,right,choice\nx,x,left\n", "row 1, sides = ('x', 'x'): must be two different things"),
        ("left,right,choice,worker\nx,y,left,\n", "row 1, column 'worker' = None"),
        ("reward,rating\n1,2\n", "columns of pairs = 'none': must be two sides"),
        ("left,left,right,choice\nx,x,y,left\n", "column = 'left': must be there only once"),
    ],
)
def test_bad_pairs(tmp_path, text, message):
    (tmp_path / "pairs.csv").write_text(text)
    with pytest.raises(InvalidValueError) as error:
        preferences.read(tmp_path / "pairs.csv")
    assert message in str(error.value)


# What the doctor makes of them


def answers(random, sd_twice, sd_others=0.3, items=200):
    """Two raters of one quality, each as noisy as said; the first answers all again."""
    true = random.normal(size=items)
    rows = [(i, "ann", t + random.normal(0, sd_twice)) for i, t in enumerate(true) for _ in range(2)]
    rows += [(i, who, t + random.normal(0, sd_others)) for i, t in enumerate(true) for who in ("bob", "cat")]
    return dict(zip(("item", "rater", "rating"), zip(*rows, strict=True), strict=True))


def test_self_consistency_names_who_contradicts_themselves():
    """Means of |x - y|: of ann's two answers 2 sd / sqrt(pi) = 1.13, of two others 0.34, of ann and another 0.83."""
    found = doctor(answers(np.random.default_rng(0), sd_twice=1.0))
    assert {f.code: f.severity for f in found.findings} == {"no-rewards": "note", "self-consistency": "warning"}
    numbers = found.findings[0].numbers
    assert numbers["repeats"] == 200
    assert numbers["own_difference_ann"] == pytest.approx(1.13, abs=0.15)
    assert numbers["difference_between_raters"] == pytest.approx((2 * 0.83 + 0.34) / 3, abs=0.06)
    json.dumps(found.as_data(), allow_nan=False)


def test_self_consistency_by_hand():
    """Ratings 1 and 4, and 2 and 2: raters differ by 3 and 0; the one earlier answer was 1.5 off."""
    columns = {"item": list("aaabb"), "rater": list("xyxxy"), "rating": [2.5, 4, 1, 2, 2]}
    (found,) = [f for f in doctor(columns).findings if f.code == "self-consistency"]
    assert found.severity == "note"
    assert found.numbers == {"repeats": 1, "own_difference": 1.5, "difference_between_raters": 1.5}


def test_raters_as_noisy_as_others_are_not_named():
    named = [
        finding.severity
        for seed in range(100)
        for finding in doctor(answers(np.random.default_rng(seed), sd_twice=0.3, items=40)).findings
        if finding.code == "self-consistency"
    ]
    assert len(named) == 100
    assert named.count("warning") <= 3


def test_a_log_without_rewards_is_not_filtered():
    log = logs.from_columns({"item": ["a"], "rater": ["x"], "rating": [1]})
    with pytest.raises(InvalidValueError, match="holds no rewards that could be filtered"):
        filtered(log)
    found = doctor(log)
    assert [f.code for f in found.findings] == ["few-ratings", "one-rater", "no-rewards"]
    json.dumps(found.as_data(), allow_nan=False)


@pytest.mark.parametrize(
    ("spoilt", "code"),
    [
        (lambda own, other: np.full(200, 3.0), "idle-raters"),
        (lambda own, other: other, "idle-raters"),
        (lambda own, other: np.where(np.arange(200) % 4 == 0, 0.0, own), "sentinel-value"),
        (lambda own, other: 25 * (own - 1), "mixed-units"),
        (lambda own, other: own, None),
    ],
)
def test_raters_are_checked_without_rewards(spoilt, code):
    """Three raters of one quality from 1 to 5, the third of whom is as said."""
    random = np.random.default_rng(0)
    quality = random.uniform(1, 5, 200)
    a, b, c = quality + random.normal(0, 0.3, (3, 200))
    columns = {"item": [*range(200)] * 3, "rater": ["a"] * 200 + ["b"] * 200 + ["c"] * 200}
    found = doctor(columns | {"rating": np.concatenate([a, b, spoilt(c, b)])})
    assert [f.code for f in found.findings] == [*([code] if code else []), "no-rewards"]
    json.dumps(found.as_data(), allow_nan=False)


def test_the_number_or_time_of_a_rating_is_no_rating(tmp_path):
    for about in ("rating_id", "rating_time", "Rating Count"):
        file = tmp_path / "log.csv"
        file.write_text(f"item,worker,{about},score\na,u,101,5\na,v,102,1\n")
        assert logs.read(file).ratings.tolist() == [[5.0, 1.0]]


def test_a_missing_time_is_before_all_others_and_compact_dates_are_dates(tmp_path):
    file = tmp_path / "log.csv"
    for last, kept in (("nan", 5.0), ("20260105", 1.0), ("20260101", 5.0)):
        file.write_text(f"item,worker,score,created_at\na,u,5,2026-01-02\na,u,1,{last}\na,v,3,\n")
        assert logs.read(file).ratings.tolist() == [[kept, 3.0]]


def test_a_list_and_a_part_of_it_are_one_column_too_many(tmp_path):
    file = tmp_path / "log.jsonl"
    file.write_text('{"reward":1,"rating":[1,2],"rating[0]":9}\n{"reward":1,"rating":[1,2]}\n')
    with pytest.raises(InvalidValueError, match=r"row 1, column = 'rating\[0\]': must be there only once"):
        logs.read(file)


def test_a_decimal_comma_is_not_called_missing(tmp_path):
    file = tmp_path / "log.csv"
    file.write_text("reward;rating_ann\n1,5;2\n")
    with pytest.raises(InvalidValueError, match=r"with a decimal point: 1\.5, not 1,5") as refused:
        logs.read(file)
    assert "--missing" not in str(refused.value)
