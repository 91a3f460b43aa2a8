"""What the doctor finds, as data and as text."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from uard._support.columns import WIDTH, fill
from uard.ratings.raters import EffectiveRaters

Severity = Literal["danger", "warning", "note"]
SEVERITIES: tuple[Severity, ...] = ("danger", "warning", "note")


@dataclass(frozen=True)
class Finding:
    """A trap that a log is in.

    Examples:
        >>> found = Finding("one-rater", "warning", "One rater.", "Blind trust.", "Have a second person rate.", {"rows": 9.0})
        >>> found.severity, found.numbers["rows"]
        ('warning', 9.0)

    Attributes:
        code: Its name, one of ``uard.diagnosis.CODES``.
        severity: ``danger``: training goes wrong; ``warning``: it may; ``note``: it would with another setting.
        evidence: What in the log shows it, in numbers.
        consequence: What it would do to training.
        remedy: What avoids it.
        numbers: The numbers of the evidence, by name.
        how: The option or the line of Python that does it; empty if there is none.
    """

    code: str
    severity: Severity
    evidence: str
    consequence: str
    remedy: str
    numbers: Mapping[str, float] = field(default_factory=dict[str, float])
    how: str = ""


@dataclass(frozen=True)
class Stratum:
    """How far raters agree within a part of a log.

    Examples:
        >>> Stratum("bart", rows=100, agreement=0.28, low=0.1, high=0.4, within=12.0, between=11.0).name
        'bart'

    Attributes:
        name: What the rows of the part have in the column.
        rows: How many of them at least two raters have rated.
        agreement: Krippendorff's alpha of these rows, <= 1; None where it is not defined.
        low: Lower end of its 95 % interval; None below ten items.
        high: Upper end, likewise.
        within: Standard deviation of the ratings of one row (their number less one), in rating units.
        between: Standard deviation of the rows' mean ratings, in rating units.
    """

    name: str
    rows: int
    agreement: float | None
    low: float | None
    high: float | None
    within: float
    between: float


@dataclass(frozen=True)
class Diagnosis:
    """What the doctor found; ``str(diagnosis)`` is all of it in words.

    Examples:
        >>> from uard import doctor
        >>> diagnosis = doctor({"reward": [0, 1, 4] * 20, "rating_ann": [0, 1, -1] * 20, "rating_bob": [0, 1, -1] * 20})
        >>> diagnosis.count("danger"), [f.code for f in diagnosis.findings]
        (0, ['idle-raters', 'reward-contradicted'])
        >>> print(str(diagnosis).splitlines()[0])
        log: 60 rows, 2 raters (rating_ann, rating_bob), 100 % of rows rated

    Attributes:
        source: Which log.
        mitigation: The filter that is going to be used.
        rows: Rows of the log.
        raters: Names of the annotators.
        rated: Share of rows that somebody rated, in [0, 1].
        agreement: Krippendorff's alpha (interval metric) of the annotators, <= 1; None where it is not defined.
        agreement_interval: Its 95 % interval over items, see ``uard.ratings.agreement.alpha_interval``, or None.
        strata: The same within each part of the rows, if a column divides them.
        independence: How many independent raters these are worth, see ``uard.ratings.agreement.independence``: against
            the true reward if it is known, else against the observed one; None where that cannot be told.
        calibration: How well sigma predicts |reward - true reward| on rated rows; None without a true reward. For
            ``sigma_h`` alone, ``sigma_h_with_proxy`` (the reward counted as one more rater) and ``sigma_m`` (if
            logged): ``spearman`` and, where there are lies and honest rows, ``auroc`` (a lie is off by over a unit).
        findings: The worst first.
    """

    source: str
    mitigation: str
    rows: int
    raters: tuple[str, ...]
    rated: float
    agreement: float | None
    agreement_interval: tuple[float, float] | None
    strata: tuple[Stratum, ...]
    independence: EffectiveRaters | None
    calibration: Mapping[str, Mapping[str, float]] | None
    findings: tuple[Finding, ...]

    def count(self, severity: Severity) -> int:
        """Return how many findings are of this severity: ``danger``, ``warning`` or ``note``."""
        return sum(f.severity == severity for f in self.findings)

    def as_data(self) -> dict[str, Any]:
        """Return everything as plain data that JSON can hold."""
        data = asdict(self)
        if self.independence is not None:
            data["independence"] = self.independence.as_data()
        return data | {name: list(data[name]) for name in ("raters", "strata", "findings")}

    def __str__(self) -> str:
        """Return the whole diagnosis as text, 80 columns wide."""
        return self.text()

    def text(self, width: int = WIDTH) -> str:
        """Return the whole diagnosis as text.

        Args:
            width: Of the longest line, unless a word is longer.
        """
        who = f"{len(self.raters)} rater{'s' * (len(self.raters) != 1)}"
        names = f" ({', '.join(self.raters)})" if 0 < len(self.raters) <= 8 else ""
        head = f"{self.source}: {row_count(self.rows)}, {who}{names}, {percent(self.rated)} of rows rated"
        lines = [fill(head, width, rest="  ")]
        lines += [fill(said, width, f"{name:12}") for name, said in self._facts()]
        for f in self.findings:
            lines += ["", f"{f.severity.upper():8}{f.code}"]
            told = {"evidence": f.evidence, "consequence": f.consequence, "remedy": f.remedy, "how": f.how}
            lines += [fill(said, width, f"  {name:12}") for name, said in told.items() if said]
        found = ", ".join(f"{self.count(s)} {s}" for s in SEVERITIES if self.count(s))
        return "\n".join([*lines, "", f"findings: {found or 'none'}"])

    def _facts(self) -> list[tuple[str, str]]:
        """Return what is known of the log beside the findings: a word, and a text."""
        alpha = "not defined (fewer than two ratings of anything, or all ratings equal)"
        if self.agreement is not None:
            ends = interval(*self.agreement_interval or (None, None))
            alpha = f"{self.agreement:z.2f}{ends} (1 perfect, 0 chance; below 0.67 by custom too low to rely on)"
        facts = [("agreement", f"Krippendorff's alpha {alpha}")]
        for s in self.strata:
            alpha = "not defined" if s.agreement is None else f"{s.agreement:z.2f}{interval(s.low, s.high)}"
            facts.append(("", f"within {s.name}: {alpha} ({row_count(s.rows)})"))
        if (i := self.independence) is not None:
            errors = "their errors" if i.against == "true_reward" else "what the reward misses, error or truth,"
            worth = f"a row's {i.raters:.3g} are worth {i.number:.3g} independent ones"
            facts.append(("raters", f"{worth} (mean correlation of {errors} {i.correlation.value:.2f})"))
        for sigma, values in (self.calibration or {}).items():
            shown = ", ".join(f"{name} {value:.3f}" for name, value in values.items())
            facts.append(("calibration", f"{sigma.replace('_with_proxy', ' with the reward as a rater')}: {shown}"))
        return [*facts, ("filter", self.mitigation)]


def percent(share: float) -> str:
    """Return a share in [0, 1] as text: ``12.5 %``."""
    text = f"{100 * share:.1f}"
    return f"{100 * share:.2g} %" if text == "0.0" and share > 0 else f"{text.removesuffix('.0')} %"


def interval(low: float | None, high: float | None) -> str:
    """Return a 95 % interval as the end of a number: `` [0.71, 0.83]``; nothing if there is none."""
    return "" if low is None or high is None else f" [{low:z.2f}, {high:z.2f}]"


def listed(parts: Iterable[str], most: int = 8) -> str:
    """Return parts as text, no more than ``most`` of them: ``a, b and 3 more``."""
    several = list(parts)
    more = f" and {len(several) - most} more" if len(several) > most else ""
    return ", ".join(several[:most]) + more


def row_count(n: int) -> str:
    """Return a number of rows as text: ``1 row``, ``2 rows``."""
    return f"{n} row" + "s" * (n != 1)
