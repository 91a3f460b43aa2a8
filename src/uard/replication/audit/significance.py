"""Section c: the statistical tests (I1-I3) and those that were not made."""

from __future__ import annotations

import math

from scipy import stats

from uard.replication import paper
from uard.replication.audit.checks import Check
from uard.replication.audit.table_3 import BASELINES
from uard.replication.audit.table_3 import ROWS as TABLE_3
from uard.replication.paper import Stat
from uard.replication.verdicts import Part

LEVEL = 0.05


def checks() -> list[Check]:
    """Return the checks of this section."""
    return [_visits(), _true_return(), _baselines(), _worse_than_dqn(), _ablation()]


def t_test(first: Stat, second: Stat, welch: bool = False, n: int = paper.SEEDS) -> tuple[float, float]:
    """Return (t, two-sided p) of a two-sample t-test from printed means and SDs."""
    result = stats.ttest_ind_from_stats(first.mean, first.sd, n, second.mean, second.sd, n, equal_var=not welch)
    return float(result[0]), float(result[1])


def _visits() -> Check:
    n, printed = paper.SEEDS, paper.TESTS["I1"]
    assert printed.t is not None
    base, uard = (r.visits for r in (paper.TABLE_4[0], paper.TABLE_4[2]))
    t, p = t_test(base, uard)
    difference, pooled = base.mean - uard.mean, math.hypot(base.sd, uard.sd)
    return Check(
        "c.visits",
        printed={"printed t": printed.t, "df": printed.df, "p below": printed.p_below},
        recomputed={
            "t": t,
            "p": p,
            "t, SDs with 1/n": t * math.sqrt((n - 1) / n),
            "largest t, other SD 0": difference / (base.sd / math.sqrt(n)),
            "and with rounding in its favour": (difference + 0.05) / ((base.sd - 0.05) / math.sqrt(n)),
            "n that gives 29.15": (printed.t * pooled / difference) ** 2,
            "difference that gives 29.15": printed.t * pooled / math.sqrt(n),
        },
        others={"n": n, "mean": base.mean, "SD": base.sd, "UARD's mean": uard.mean, "UARD's SD": uard.sd},
        claims=(
            Part("t is the printed one", lambda n: round(n["t"], 2) == n["printed t"]),
            Part("the degrees of freedom are the printed ones", lambda n: 2 * (n["n"] - 1) == n["df"]),
            Part("p is below the printed bound", lambda n: n["p"] < n["p below"]),
        ),
        findings=(
            Part(
                "not even an SD of zero gives the printed t",
                lambda n: n["and with rounding in its favour"] < n["printed t"],
            ),
        ),
    )


def _true_return() -> Check:
    base, uard = (r.true_return for r in (paper.TABLE_4[0], paper.TABLE_4[2]))
    t, p = t_test(uard, base, welch=True)
    ratio = (base.sd / uard.sd) ** 2
    return Check(
        "c.true-return",
        printed={"p below": paper.TESTS["I2"].p_below},
        recomputed={
            "Welch t": t,
            "Welch p": p,
            "variance ratio": ratio,
            "variance p": 2.0 * float(stats.f.sf(ratio, paper.SEEDS - 1, paper.SEEDS - 1)),
        },
        claims=(
            Part("the means differ", lambda n: n["Welch p"] < n["p below"]),
            Part("the variances differ", lambda n: n["variance p"] < n["p below"]),
        ),
    )


def _baselines() -> Check:
    uard = TABLE_3["UARD"].visits
    p = {m: min(1.0, len(BASELINES) * t_test(TABLE_3[m].visits, uard, welch=True)[1]) for m in BASELINES}
    return Check(
        "c.baselines",
        printed={"p below": paper.TESTS["I3"].p_below},
        recomputed=p,
        claims=tuple(Part(f"UARD differs from {m}", lambda n, m=m: n[m] < n["p below"]) for m in BASELINES),
    )


def _worse_than_dqn() -> Check:
    tests = {m: t_test(TABLE_3[m].visits, TABLE_3["DQN"].visits, welch=True) for m in BASELINES if m != "DQN"}
    return Check(
        "c.worse-than-dqn",
        recomputed={f"t {m}": t for m, (t, _) in tests.items()} | {f"p {m}": p for m, (_, p) in tests.items()},
        others={"level": LEVEL},
        findings=(
            Part("CQL hacks significantly more", lambda n: n["t CQL"] > 0 and n["p CQL"] < n["level"]),
            Part("TRPO hacks significantly more", lambda n: n["t TRPO"] > 0 and n["p TRPO"] < n["level"]),
            Part("CPO does not differ", lambda n: n["p CPO"] >= n["level"]),
        ),
    )


def _ablation() -> Check:
    baseline, *variants = paper.TABLE_5
    p = {f"p {r.variant}": t_test(baseline.visits, r.visits, welch=True)[1] for r in variants}
    same = next(r for r in paper.TABLE_4 if r.agent == "Multi-Head").visits
    undiscounted = [r for r in variants if not r.discounting]
    return Check(
        "c.ablation",
        recomputed=p,
        others={"level": LEVEL, "mean in Table 4": same.mean, "SD in Table 4": same.sd}
        | {f"p {r.variant}, corrected": min(1.0, len(undiscounted) * p[f"p {r.variant}"]) for r in undiscounted},
        claims=(
            Part(
                "Ablation I differs, after correction for two tests",
                lambda n: n["p Ablation I, corrected"] < n["level"],
            ),
            Part(
                "Ablation II differs, after correction for two tests",
                lambda n: n["p Ablation II, corrected"] < n["level"],
            ),
        ),
        findings=(
            Part("Ablation I does not differ before correction either", lambda n: n["p Ablation I"] >= n["level"]),
            Part("Ablation II differs before correction", lambda n: n["p Ablation II"] < n["level"]),
        ),
    )
