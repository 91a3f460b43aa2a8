"""``uard judges fit``: from a log of scores to a panel of judges. Needs no JAX."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from uard import __version__, _checks
from uard.cli import terminal
from uard.cli.settings import Words

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True)
class Judges:
    """Fit a panel to the scores of several judges: on which scale each one scores, and how far each is to be believed.

    Prints location and scale of each judge, who fails, who is redundant, who cannot tell the completions of one prompt
    apart, and how many independent judges they are worth.
    """

    action: Positional[Literal["fit"]]
    """What to do: fit."""
    files: Positional[tuple[str, ...]]
    """CSV, JSON, JSONL or Parquet files with a row per completion: a column `scores` of objects, such as
    {"clarity": 0.5}, or a column per judge (then --judges); or TRL's files of completions."""
    out: Annotated[str | None, arg(aliases=["-o"])] = None
    """Write the panel to this JSON file, for `panel=`."""
    judges: tuple[str, ...] = ()
    """The judges' columns, or some of those in `scores`; all of `scores` if left out."""
    prompt: str | None = None
    """The column of prompts, `prompt` if it is there; completions of one prompt are compared with each other."""
    truth: str | None = None
    """A column that says what completions are really worth, where somebody knows."""
    missing: Words = ()
    """A further word or number that means that a score is missing, e.g. -1, whichever judge gives it. Repeatable. The
    panel knows it, too: where a judge gives this number later, its score is missing."""
    failures: Words = ()
    """A score that one judge gives where it has failed, as judge=score, e.g. tone=-1; tone= where all are scores.
    Repeatable. Of a judge without one, failures are looked for in the log; rare ones are often not found."""
    rule: str = "uard"
    """How scores become one reward: uard, mean, median, lowest, uwo, log-mean-exp, lcb."""
    proxy: str = "mean"
    """What the rule believes or doubts: mean, median, or the name of a judge."""
    json: str | None = None
    """Write one JSON object to this file; - for standard output."""

    def run(self, console: Console) -> None:
        """Fit, print, and write the panel."""
        from uard.judges import fit, read_scores

        for field, output in (("out", self.out), ("json", self.json)):
            terminal.check_json(output, *self.files, field=field)
        if self.out is not None and self.out == self.json:
            raise _checks.InvalidValueError("--json", self.json, "another file than --out")
        if not self.files:
            raise _checks.InvalidValueError("files", [], "at least one file with a row per completion")
        log = read_scores(self.files, self.judges or None, prompt=self.prompt, truth=self.truth, missing=self.missing)
        fitted = fit(log, rule=self.rule, proxy=self.proxy, failures=_by_judge(self.failures))
        if self.out is not None:
            fitted.panel.save(self.out)
        if self.json is not None:
            terminal.write_json({"version": __version__} | fitted.as_data(), self.json)
        if self.json != "-":
            terminal.lines(fitted.text(terminal.width()))
        if self.out is not None:
            terminal.say(console, f"the panel is in {self.out}: JudgePanel.load({self.out!r}), or panel={self.out!r}")


def _by_judge(words: Sequence[str]) -> dict[str, list[float]]:
    """Return failures by judge; the last ``=`` divides, for a judge may have one in its name."""
    found: dict[str, list[float]] = {}
    for word in words:
        judge, sign, score = word.rpartition("=")
        values = found.setdefault(judge, [])
        if sign and judge and not score:
            continue
        try:
            values.append(float(score if sign and judge else ""))
        except ValueError:
            raise _checks.InvalidValueError("failures", word, "judge=score, such as tone=-1") from None
    return found
