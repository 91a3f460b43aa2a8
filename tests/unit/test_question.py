"""A project's question: what cannot be asked is refused when the project is opened."""

import pytest

from uard._checks import InvalidValueError
from uard.collect.question import Known, Question, as_toml, question_of

X, Y = "0" * 32, "1" * 32


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"kind": "scale"}, "kind = 'scale'"),
        ({"low": 1.0, "high": 1.0}, "high = 1.0: must be more than low"),
        ({"stars": 1}, "stars = 1"),
        ({"attributes": ("reward",)}, "other names than the columns"),
        ({"attributes": ("id",)}, "other names than the columns"),
        ({"attributes": ("=1+1",)}, "not beginning with"),
        ({"attributes": ("a\nb",)}, "printable"),
        ({"attributes": ("x" * 101,)}, "1 to 100"),
        ({"attributes": ("safe", "safe")}, "different names"),
        ({"attributes": ([1],)}, "printable"),
        ({"attributes": ("safe",), "kind": "pairs"}, "left out for pairs"),
        ({"acquisition": "bogus"}, "acquisition = 'bogus': must be one of"),
        ({"acquisition": 5}, "acquisition = 5"),
        ({"acquisition": {}}, "not all of them 0"),
        ({"acquisition": {"random": -1.0}}, "acquisition"),
        ({"overlap": 0}, "overlap = 0"),
        ({"repeats": 1.0}, "repeats = 1.0"),
        ({"practice": (Known(X, 9.0),)}, f"practice: value of item {X} = 9.0"),
        ({"gold": (Known(X, 0.5), Known(X, 0.5))}, "there only once"),
        ({"kind": "thumbs", "gold": (Known(X, -1.0),)}, "1 or 0, for up or down"),
        ({"kind": "thumbs", "practice": (Known(X, 0.5),)}, "1 or 0, for up or down"),
        ({"kind": "pairs", "gold": (Known(X, 0.3),)}, r"1, 0 or 0\.5, for left, right or a tie"),
        ({"gold": (Known(X, 0.5),), "practice": (Known(X, 0.5),)}, "none of practice and examples"),
        ({"gold": (Known(X, 0.5),), "examples": (Known(X, 0.5),)}, "none of practice and examples"),
        ({"attributes": ("Rating",)}, "other names than the columns"),
        ({"attributes": ("worker id",)}, "would be read as one of them"),
        ({"attributes": (" =1+1",)}, "not beginning with"),
        ({"low": -1e300}, "low"),
    ],
)
def test_what_cannot_be_asked(fields, message):
    with pytest.raises(InvalidValueError, match=message):
        Question(**fields)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"coment": True}, "field = 'coment'.*did you mean 'comment'"),
        ({"examples": []}, "table = 'examples'.*did you mean 'example'"),
        ({"gold": [{"value": 1.0}]}, "gold"),
        ({"gold": "all"}, "gold"),
        ({"attributes": "safe"}, "a list of names"),
        ({"low": "0"}, "project.toml: low = '0'"),
        ({"acquisition": "near-tie"}, "project.toml: acquisition = 'near-tie'.*did you mean 'near-ties'"),
    ],
)
def test_a_file_that_is_wrong_is_named(data, message):
    with pytest.raises(InvalidValueError, match=message):
        question_of(data)


def test_what_is_written_is_read_again():
    import tomllib

    question = Question(
        question='How "good"? \\ 100 %\u2028', attributes=("safe",), comment=True, gold=(Known(X, 0.5, 0.1, "why"),),
        examples=(Known(Y, -1.0),), acquisition={"random": 0.25, "least-known": 0.75},
    )  # fmt: skip
    assert question_of(tomllib.loads(as_toml(question))) == question
