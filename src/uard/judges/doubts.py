"""What users are told about judges and completions, and in which words."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from uard.judges.asking import Answer, JudgeError, Scores, said
from uard.judges.panel import AGREE, Combined

MESSAGES = "Completions are lists of messages here: completion[-1]['content'] is the text of the last one"


class UnscoredWarning(UserWarning):
    """No judge scored a completion, so it teaches nothing."""


class LateJudgeWarning(UserWarning):
    """A judge did not answer within its limit, so its scores are missing."""


class FailedJudgeWarning(UserWarning):
    """A judge raised, so its scores are missing."""


class Doubt(NamedTuple):
    """Something to warn of, once.

    Attributes:
        about: What tells it from other doubts.
        kind: Of warning.
        text: What to say.
    """

    about: str
    kind: type[UserWarning]
    text: str


class Missed(NamedTuple):
    """Which scores of a judge are missing because it was late or failed, of a batch.

    Attributes:
        late: Of how many completions because it was late.
        failed: Of how many because it raised.
        error: What it raised, or None.
    """

    late: int
    failed: int
    error: BaseException | None


def missed(answer: Answer, size: int) -> Missed:
    """Return what is missing of a judge's answer about ``size`` completions.

    Examples:
        >>> missed(Answer(None, 3.0, late=True), size=4)
        Missed(late=4, failed=0, error=None)
    """
    if answer.late:
        return Missed(size, 0, None)
    if answer.error is not None:
        return Missed(0, size, answer.error)
    given = answer.given
    return Missed(given.late, given.failed, given.error) if isinstance(given, Scores) else Missed(0, 0, None)


def advice(completions: Sequence[Any]) -> str:
    """Return what a judge that raised may not have known about completions; nothing where they are texts.

    Examples:
        >>> advice([[{"role": "assistant", "content": "so"}]])
        "Completions are lists of messages here: completion[-1]['content'] is the text of the last one"
    """
    return MESSAGES if len(completions) and isinstance(completions[0], list) else ""


def raise_if_all_raised(errors: Sequence[JudgeError | None], completions: Sequence[Any]) -> None:
    """Raise what the first judge raised, if all did.

    Args:
        errors: Of each judge.
        completions: What they were asked about.

    Raises:
        JudgeError: with advice as a note.
    """
    raised = [error for error in errors if error is not None]
    if not raised or len(raised) < len(errors):
        return
    if note := advice(completions):
        raised[0].add_note(note)
    raise raised[0]


def doubts_of_answers(
    answers: Mapping[str, Answer], completions: Sequence[Any], limits: Mapping[str, float]
) -> Iterator[Doubt]:
    """Say which judges were late or raised.

    Args:
        answers: By judge.
        completions: What they were asked about.
        limits: Seconds that judges had for the batch, by name.
    """
    size = len(completions)
    for name, answer in answers.items():
        late, failed, error = missed(answer, size)
        lost = "its disagreement counts as 0 for" if name == "sigma_m" else "its scores are missing for"
        if late:
            within = f" within {limits[name]:g} s" if answer.late and name in limits else " in time"
            again = ", and it is not asked again while it is still at work" if answer.late else ""
            text = f"judge {name!r} did not answer{within}: {lost} {late} of {size} completions{again}. From now on "
            yield Doubt(f"late {name}", LateJudgeWarning, text + "this is counted only")
        if failed:
            assert error is not None
            text = f"judge {name!r} raised {said(error)}: " if answer.error is None else f"{error}: "
            text += f"{lost} {failed} of {size} completions. From now on this is counted only"
            note = advice(completions)
            yield Doubt(f"failed {name}", FailedJudgeWarning, f"{text}. {note}" if note else text)


def whys(combined: Combined) -> list[str]:
    """Return what ``combined.why`` says of each completion, in half its time: numbers become text a column at a time.

    Examples:
        >>> combined = Combined(*np.array([[0.5], [1.0], [0.0], [0.5]]), np.array([[0.4, 0.6]]), ("a", "b"))
        >>> whys(combined), whys(combined) == [combined.why(0)]
        (['agreed (b +0.6, a +0.4): believed to 100 %'], True)
    """
    size, judges = combined.ratings.shape
    columns = zip(combined.judges, combined.ratings.T.tolist(), strict=True)
    texts = ["\n".join([name.replace("%", "%%") + " %+.1f"] * size) % tuple(column) for name, column in columns]
    cells = [text.split("\n") for text in texts]  # no name has a line end
    order: list[list[int]] = np.argsort(
        -combined.ratings, axis=1, kind="stable"
    ).tolist()  # who said nothing comes last
    known = (~np.isnan(combined.ratings)).sum(1).tolist()
    out: list[str] = []
    for row, (ranks, number, weight) in enumerate(zip(order, known, combined.weight.tolist(), strict=True)):
        each = ", ".join([cells[k][row] for k in (ranks if number == judges else ranks[:number])])
        if number >= 2:
            out.append(f"{'agreed' if weight >= AGREE else 'contested'} ({each}): believed to {100 * weight:.0f} %")
        else:
            out.append(f"{each} alone: nobody to compare with" if number else "no judge scored it")
    return out
