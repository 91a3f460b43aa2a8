"""A fitted panel, and what its log tells of the judges: a table, and what a user should know before training."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, NamedTuple

from uard._support.columns import WIDTH, fill
from uard._support.columns import text as columns_text
from uard.judges.panel import FittedJudge, JudgePanel
from uard.judges.rules import name_of_rule
from uard.ratings.jackknife import Estimate, texts
from uard.ratings.raters import EffectiveRaters, PanelSummary, RaterSummary

FEW = 100  # completions, below which a scale is rough
LEGEND = """\
location, scale: mean and standard deviation of its ordinary scores, in its own unit; the rest is in these deviations
bias: what it says beyond the proxy; own view: how far it differs from the others beyond that (a standard deviation)
with others: correlation with the mean of the others (95 %)"""


class Fitted(NamedTuple):
    """A panel, and what the log says about it; ``str(fitted)`` is a table.

    Attributes:
        panel: What combines scores.
        summary: Of the standardised scores, as of raters: noise, correlation with the others, copies, effective number.
        redundant: Pairs of judges whose scores correlate by 0.95 or more, and by how much.
        source: Where the log is from.
        failures: By judge: scores that are failures, and how often the log has them.
        found: By judge: those of them that nobody has declared.
        groups: How many prompts have several completions; None if prompts are not known.
        truth: Whether the log says what completions are worth.
    """

    panel: JudgePanel
    summary: PanelSummary
    redundant: tuple[tuple[str, str, float], ...]
    source: str
    failures: Mapping[str, Mapping[float, int]]
    found: Mapping[str, tuple[float, ...]]
    groups: int | None
    truth: bool

    @property
    def effective(self) -> EffectiveRaters | None:
        """How many independent judges they are worth; None where that cannot be told.

        Without a truth it is a bound by what judges share, which one who says the opposite, or one who has nothing in
        common with the others, would hide.
        """
        found = self.summary.effective
        hidden = self._contrary() or self._strangers()
        return None if found is not None and found.against == "part" and hidden else found

    def words_of(self, judge: FittedJudge) -> list[str]:
        """Return what stands out of a judge."""
        told = self._told(judge)
        words: list[str] = []
        if judge.counts and not judge.heard:
            words.append("not heard by uard: much noisier than the others")
        if judge.scale == 0:
            words.append("always the same score: left out")
        elif judge.tells_apart is False:
            words.append("never tells the completions of one prompt apart: left out")
        words += [
            f"{x:g} ({n} times) is a failure, no score" for x, n in self.failures.get(judge.name, {}).items() if n
        ]
        words += [w for w in told.words if w.startswith(("contrary", "noisy", "the same as"))]
        copies = {name for word in words for name in word.removeprefix("the same as ").split(", ")}
        words += [f"redundant beside {other} ({r:.2f})" for a, b, r in self.redundant if judge.name in (a, b)
                  and (other := b if a == judge.name else a) not in copies]  # fmt: skip
        return words

    def warnings(self) -> list[str]:
        """Return what a user should know before training, a sentence each."""
        judges = self.panel.judges
        found: list[str] = []
        for judge in judges:
            for value, times in self.failures.get(judge.name, {}).items():
                if times == 0:
                    found.append(f"judge {judge.name!r} never says {value:g} in this log, which was declared a failure")
                elif value in self.found.get(judge.name, ()):
                    found.append(
                        f"judge {judge.name!r}: {value:g} ({times} times) is taken for a failure; if it is a score: "
                        f"--failures {judge.name}="
                    )
            if not judge.counts:
                found.append(f"judge {judge.name!r} is left out: it tells no completions apart")
            elif judge.missing > 0.5:
                found.append(f"judge {judge.name!r} scored only {100 * (1 - judge.missing):.0f} % of the completions")
        if self.panel.completions < FEW:
            found.append(f"only {self.panel.completions} completions: all this is rough, and some hundred are better")
        found += [*self._of_agreement(), *(
            f"judges {a!r} and {b!r} say the same (correlation {r:.2f}): leave one out, or it counts twice"
            for a, b, r in self.redundant
        )]  # fmt: skip
        if sum(judge.counts for judge in judges) < 2:
            found.append("fewer than two judges are left: nothing can be checked against anything")
        if not self.groups:
            what = "no prompts (--prompt)" if self.groups is None else "no prompt with two completions"
            found.append(f"{what}: nobody was checked for telling the completions of one prompt apart")
        e = self.effective
        if e is not None and e.against == "true_reward" and e.number.value < 0.5 * e.raters:
            found.append(f"{e.raters:.3g} judges are worth {e.number:.1f} independent ones: they err together")
        return found

    def as_data(self) -> dict[str, Any]:
        """Return everything as plain data that JSON can hold; what is not known is None."""
        return {
            "source": self.source,
            "completions": self.panel.completions,
            "rule": name_of_rule(self.panel.rule),
            "proxy": self.panel.proxy,
            "judges": [asdict(judge) | {"words": self.words_of(judge)} for judge in self.panel.judges],
            "redundant": [{"judges": [a, b], "correlation": r} for a, b, r in self.redundant],
            "effective": None if self.effective is None else self.effective.as_data(),
            "warnings": self.warnings(),
        }

    def __str__(self) -> str:
        """Return a table, and what stands out, 80 columns wide."""
        return self.text()

    def text(self, width: int = WIDTH) -> str:
        """Return a table, and what stands out.

        Args:
            width: Of the longest line, unless a word is longer.
        """
        judges, others = self.panel.judges, [r.with_others for r in self.summary.raters]
        columns = {
            "judge": [j.name for j in judges],
            "missing": [f"{100 * j.missing:.0f} %" for j in judges],
            "location": texts([Estimate(j.location) for j in judges]),
            "scale": texts([Estimate(j.scale) for j in judges]),
            "bias": [f"{j.bias:+.2f}" for j in judges],
            "own view": [f"{j.idiosyncrasy**0.5:.2f}" for j in judges],
            "with others": ["?" if e is None else f"{e:z.2f}" for e in others],
        }
        how = f"rule {name_of_rule(self.panel.rule)}, proxy {self.panel.proxy}"
        count = f"{self.source}: {self.panel.completions} completions, {len(judges)} judges; {how}"
        table = columns_text([*columns], zip(*columns.values(), strict=True), width)
        words = {j.name: self.words_of(j) for j in judges}
        notes = [f"{name}: {'; '.join(several)}" for name, several in words.items() if several]
        notes += [*LEGEND.split("\n"), self._worth(), *(f"! {w}" for w in self.warnings())]
        return "\n".join([fill(count, width, rest="  "), table, *(fill(x, width, rest="  ") for x in notes)])

    def _told(self, judge: FittedJudge) -> RaterSummary:
        return next(rater for rater in self.summary.raters if rater.name == judge.name)

    def _correlation(self, judge: FittedJudge) -> float:
        others = self._told(judge).with_others
        return 1.0 if others is None else others.value

    def _contrary(self) -> list[FittedJudge]:
        """Return judges that say the opposite of the others, the most contrary first."""
        found = [j for j in self.panel.judges if any(w.startswith("contrary") for w in self._told(j).words)]
        return sorted(found, key=self._correlation)

    def _strangers(self) -> list[FittedJudge]:
        """Return judges whose scores have nothing in common with those of the others, as far as one can tell."""
        contrary, found = self._contrary(), list[FittedJudge]()
        for judge in self.panel.judges:
            others = self._told(judge).with_others
            if judge.counts and judge not in contrary and others is not None and others.low is not None:
                found += [judge] if others.low <= 0 else []
        return found

    def _of_agreement(self) -> list[str]:
        """Say who contradicts the others and who has nothing in common with them: nothing, of one who agrees."""
        contrary, strangers = self._contrary(), self._strangers()
        counting = [judge for judge in self.panel.judges if judge.counts]
        if len(counting) == 2 and len(contrary) == 2:
            return [f"judges {counting[0].name!r} and {counting[1].name!r} contradict each other: is one of them the "
                    "wrong way round?"]  # fmt: skip
        if contrary:
            again = " Mend it and fit again before you believe the rest" if len(contrary) + len(strangers) > 1 else ""
            first = f"judge {contrary[0].name!r} says the opposite of the others: is its score the wrong way round?"
            return [first + again]
        if strangers and len(strangers) == len(counting):
            return ["these judges have nothing in common: no score is confirmed by another one"]
        return [
            f"judge {judge.name!r} has nothing in common with the others (correlation {self._correlation(judge):.2f}): "
            "is it noise, or does it judge something else?"
            for judge in strangers
        ]

    def _worth(self) -> str:
        e = self.effective
        if e is None:
            why = "it takes prompts with several completions, or what some completions are really worth: --truth"
            if self._contrary() or self._strangers():
                why = "not while judges contradict each other, or have nothing in common"
            elif self.truth or self.groups:
                why = "it takes 30 completions that two judges have scored, of known worth or of prompts with several"
            return f"independent judges: not known ({why})"
        if e.against == "part":
            low = max(1.0, e.number.value if e.number.low is None else e.number.low)
            return (
                f"independent judges: between {low:.1f} and {e.raters:.1f}; only --truth tells. The first, if all that "
                "they share about the completions of one prompt were error: good judges share the truth"
            )
        return (
            f"independent judges: {e.number:.2f} of {e.raters:.3g} that scored a completion on average; mean "
            f"correlation of their errors {e.correlation:z.2f} (95 %)"
        )
