"""Whatever a file or a table holds, the readers give a log or name what is wrong; the order of answers is nothing."""

from __future__ import annotations

import json
import math
import tempfile
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from uard import InvalidValueError, RatingLog
from uard.ratings import preferences, readers
from uard.ratings.agreement import krippendorff_alpha

QUICK = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])
NAMES = ("reward", "rating", "rating_a", "ratings", "item", "task", "annotator", "user", "label", "created_at", "left",
         "right", "choice", "sigma_m", "episode", "id", "q:::1", "responses", "annotations", "data", "x")  # fmt: skip
WORDS = ("", "1", "-2.5", "?", "n/a", "nan", "inf", "1_0", "٣", "left", "a", '"', "\0", "2026-10-01", "1e999", "x\ny")
KEYS = st.sampled_from(("user_id", "value", *NAMES))
NESTED = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.sampled_from(WORDS) | st.just(10**400),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(KEYS, inner, max_size=3),
    max_leaves=6,
)
ROWS = st.lists(st.dictionaries(st.sampled_from(NAMES), NESTED, max_size=6), max_size=5)


def read_as(suffix: str, data: bytes) -> None:
    """Read a file by both readers; only the error that names what is wrong may come out."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"log{suffix}"
        path.write_bytes(data)
        for read in (readers.read, preferences.read):
            with suppress(InvalidValueError):
                found = read(path)
                assert len(found) >= isinstance(found, RatingLog)


@given(st.sampled_from(list(readers.FORMATS)), st.binary(max_size=200))
@QUICK
def test_any_bytes(suffix, data):
    read_as(suffix, data)


@given(st.data())
@QUICK
def test_any_csv(data):
    names = data.draw(st.lists(st.sampled_from(NAMES), min_size=1, max_size=6))
    rows = data.draw(st.lists(st.lists(st.sampled_from(WORDS), min_size=len(names), max_size=len(names)), max_size=4))
    separator = data.draw(st.sampled_from((",", ";", "\t")))
    read_as(".csv", "\n".join(separator.join(row) for row in (names, *rows)).encode())


@given(ROWS, st.booleans())
@QUICK
def test_any_json(rows, truncated):
    text = json.dumps(rows)
    read_as(".json", text[: len(text) // 2 if truncated else None].encode())
    read_as(".jsonl", "\n".join(map(json.dumps, rows)).encode())


@given(st.dictionaries(st.sampled_from(NAMES), NESTED | st.lists(NESTED, max_size=4), max_size=6))
@QUICK
def test_any_columns(columns):
    with suppress(InvalidValueError):
        readers.from_columns(columns)


@given(st.data())
@QUICK
def test_the_order_of_answers_is_nothing(data):
    """Each (item, rater) is answered once or twice, at times of their own."""
    keys = data.draw(st.lists(st.tuples(st.integers(0, 4), st.sampled_from("abc")), min_size=1, max_size=12))
    rows = [(item, who, data.draw(st.integers(1, 5)), i) for i, (item, who) in enumerate(keys)]

    def log_of(rows: list[tuple[int, str, int, int]]) -> RatingLog:
        return readers.from_columns(
            dict(zip(("item", "rater", "rating", "time"), zip(*rows, strict=True), strict=True))
        )

    one, other = log_of(rows), log_of(data.draw(st.permutations(rows)))
    assert one.raters == other.raters
    by_item = [log.ratings[np.argsort(log.item.astype(str))] for log in (one, other)]
    assert np.array_equal(*by_item, equal_nan=True)
    alphas = [krippendorff_alpha(log.ratings) for log in (one, other)]
    assert alphas[0] == alphas[1] or math.isclose(*alphas, abs_tol=1e-12)
    repeated = [
        sorted(zip(log.item[log.repeats.row], *log.repeats[1:], strict=True)) if log.repeats else []
        for log in (one, other)
    ]
    assert repeated[0] == repeated[1]
    assert len(repeated[0]) == len(keys) - len(set(keys))


@pytest.mark.parametrize("size", [0, 1, 7])
def test_a_truncated_parquet_file_is_named(tmp_path, size):
    """Cut anywhere, it is no Parquet file."""
    pa, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    parquet.write_table(pa.table({"reward": [1.0], "rating": [1.0]}), tmp_path / "log.parquet")
    read_as(".parquet", (tmp_path / "log.parquet").read_bytes()[: size * 40])
