import json
import subprocess
import sys

import gymnasium
import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

import uard.envs  # noqa: F401  (registers ids)
from uard import InvalidValueError, RatingLog
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
    ("jsonl", "", "a JSONL file with at least one row"),
    ("jsonl", '{"reward": 1, "rating": 1}\n{"reward": 1,', "row 2 = '{\"reward\": 1,': must be JSON"),
    ("jsonl", "[1, 2]\n", "row 1 = [1, 2]: must be a JSON object"),
    ("jsonl", '{"reward": 1, "rating": 1}\n{"rewrd": 1}', "row 2, column = 'reward': must be one of rewrd"),
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
    with pytest.raises(InvalidValueError, match="column = 'reward': must be one of rating_a, score"):
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
