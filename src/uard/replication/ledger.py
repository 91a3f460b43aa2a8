"""The ledger: every claim of the paper that a grid can answer, what was run, our number, and a verdict.

A verdict on a number is computed from it by the condition beside it. Where a claim has parts that no number answers (a
derivation, a cross-reference, MuJoCo), that part is our reading of the text, and ``why`` says so. Claims about deep agents are answered
from the published results, those about MuJoCo too.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from uard import __version__
from uard.lab import statistics
from uard.lab.statistics import Summary
from uard.lab.views import published
from uard.lab.views.evidence import Evidence
from uard.lab.views.tables import full, number
from uard.method.weights import ReliabilityFilter, reciprocal_weight, wiener_weight
from uard.replication import deep, locomotion, paper, theory

VERDICTS = HOLDS, IN_PART, FAILS, UNTESTABLE = "holds", "holds in part", "does not hold", "cannot be tested"


@dataclass(frozen=True)
class Entry:
    """One line of the ledger.

    Attributes:
        claim: Inventory id.
        statement: The claim, in one sentence.
        line: Its line in the paper's source; 0 for a whole table.
        ran: What was run.
        ours: Our number, with its 95 % interval over seeds where it has one.
        verdict: One of the four.
        why: The reason, from the numbers.
    """

    claim: str
    statement: str
    line: int
    ran: str
    ours: str
    verdict: str
    why: str


_Answer = tuple[str, str, str, str]  # ran, ours, verdict, why
CLAIMS: dict[str, Callable[[Evidence], _Answer]] = {}
_TABLES = {
    "F2": "Table 2: trap hits by grid size, UARD against the baseline.",
    "F3": "Table 3: baselines on 10x10: 4289.5 visits for DQN, 274 for UARD, per 100 episodes.",
    "F4": "Table 4: returns, visits and gap of three agents on 6x6.",
    "F5": "Table 5: component ablation on 6x6.",
    "I1": "t(18) = 29.15, p < .001 for trap visits, UARD against the baseline.",
    "I2": "The improvement in true return stability is significant (p < .01).",
    "I3": "All pairwise t-tests on Table 3 have p < .001 after Bonferroni.",
}


def _claim(*ids: str) -> Callable[[Callable[[Evidence], _Answer]], Callable[[Evidence], _Answer]]:
    def register(answer: Callable[[Evidence], _Answer]) -> Callable[[Evidence], _Answer]:
        for i in ids:
            CLAIMS[i] = answer
        return answer

    return register


def entries(evidence: Evidence) -> list[Entry]:
    """Return the whole ledger, tables and tests first."""
    ids = [*_TABLES, *sorted((c for c in CLAIMS if c.startswith("J")), key=lambda c: int(c[1:]))]
    out = []
    for i in ids:
        line, statement = (0, _TABLES[i]) if i in _TABLES else paper.CLAIMS[i]
        out.append(Entry(i, statement, line, *CLAIMS[i](evidence)))
    return out


def as_data(entries: Sequence[Entry], seeds: Sequence[int]) -> dict[str, Any]:
    """Return the ledger as plain data, for ``ledger.json``."""
    return {"version": __version__, "seeds": list(seeds), "entries": [asdict(e) for e in entries]}


def to_rich(entries: Sequence[Entry]) -> None:
    """Print the ledger."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    colour = {HOLDS: "green", IN_PART: "yellow", FAILS: "red", UNTESTABLE: "dim"}
    table = Table("claim", "statement", "ours", "verdict", "why", show_lines=True)
    for e in entries:
        verdict = f"[{colour[e.verdict]}]{e.verdict}[/]"
        table.add_row(e.claim, escape(e.statement), escape(e.ours), verdict, escape(e.why))
    Console().print(table)


def _verdict(good: int, of: int) -> str:
    return HOLDS if good == of else FAILS if good == 0 else IN_PART


def _reduction(ours: Summary, baseline: Summary) -> float:
    return 100 * (1 - ours.mean / baseline.mean)


def _percent(x: float) -> str:
    return f"{x:.1f} %"


def _p(p: float) -> str:
    return "p < 1e-6" if p < 1e-6 else f"p = {p:.2g}"


# --- tables and tests -------------------------------------------------------------------------------------------------


@_claim("F2")
def _f2(e: Evidence) -> _Answer:
    parts, matched = [], 0
    for printed in paper.TABLE_2:
        base = e.get("scale", "trap_visits", agent="baseline", size=printed.size, panel="main")
        ours = e.get("scale", "trap_visits", agent="uard-paper", size=printed.size, panel="main")
        parts.append(f"{printed.size}x{printed.size}: {full(ours)} / {full(base)}")
        matched += abs(base.mean - printed.baseline.mean) <= printed.baseline.sd
    why = (
        f"{matched} of 3 baseline rows agree within the printed SD, per episode. The other rows exceed what an episode "
        "has room for; as totals over 100 episodes they would mean about one visit per episode, hardly any hacking."
    )
    return (
        "study scale, main panel: uard-paper / baseline, visits per episode",
        "; ".join(parts),
        _verdict(matched, 3),
        why,
    )


@_claim("F3")
def _f3(e: Evidence) -> _Answer:
    base, ours, walker = (
        e.get("table3", "trap_visits", agent=a, horizon=100, panel="main")
        for a in ("baseline", "uard-paper", "random walk")
    )
    goal = e.get("table3", "goal_rate", agent="uard-paper", horizon=100, panel="main")
    dqn, uard = paper.TABLE_3[0].visits.mean / 100, paper.TABLE_3[-1].visits.mean / 100
    good = [abs(base.mean - dqn) <= 1.0, abs(ours.mean - uard) <= 1.0, goal.mean > 0.5]
    p = published.packaged()
    agents = {r["agent"]: p.of(r, "trap_visits") for r in p.rows("deep-baselines", horizon=100, mitigation="raw")}
    printed = {deep.AGENT[row.method]: row.visits for row in paper.TABLE_3 if row.method in deep.AGENT}
    close = {a: abs(agents[a].mean - v.mean / 100) <= v.sd / 100 for a, v in printed.items() if a in agents}
    of_deep = (
        f"Of the deep baselines {sum(close.values())} of {len(close)} lie within the printed SD; ours: "
        + ", ".join(f"{a} {number(s.mean)}" for a, s in agents.items())
        + "."
        if close
        else "The deep baselines are not among the published results."
    )
    why = (
        f"Epsilon-greedy tabular Q-learning at T = 100 makes {number(base.mean)} visits (paper: DQN {dqn:.1f}, CQL "
        f"{paper.TABLE_3[1].visits.mean / 100:.1f}); T = 80 cannot. UARD as printed avoids traps but reaches the goal in "
        f"{_percent(100 * goal.mean)} of episodes; a random walker makes {number(walker.mean)} visits. {of_deep}"
    )
    ours_text = f"baseline {full(base)}; uard-paper {full(ours)}; random walk {full(walker)}"
    return "study table3, T = 100, main panel, visits per episode", ours_text, _verdict(sum(good), 3), why


@_claim("F4")
def _f4(e: Evidence) -> _Answer:
    names = {"Baseline": "baseline", "Multi-Head": "multi-head", "UARD": "uard-paper"}
    cells, parts, agree, total = [], [], 0, 0
    for printed in paper.TABLE_4:
        agent = names[printed.agent]
        row = [("true", "true_return", printed.true_return), ("obs", "observed_return", printed.observed_return)]
        row += [("visits", "trap_visits", printed.visits)]
        row += [("gap", "alignment_gap", printed.gap)] if printed.gap else []
        for short, metric, stat in row:
            s = e.get("table4", metric, agent=agent, panel="appendix")
            total += 1
            fits = abs(s.mean - stat.mean) <= stat.sd
            agree += fits
            if not fits:
                cells.append(f"{printed.agent} {short} {stat.mean:g}")
        true, visits = (e.get("table4", m, agent=agent, panel="appendix") for m in ("true_return", "trap_visits"))
        parts.append(f"{printed.agent}: true {brief_ci(true)}, visits {brief_ci(visits)}")
    why = (
        f"{agree} of {total} numbers lie within the printed SD; not: {', '.join(cells)}. The UARD row mixes two agents: "
        "observed 9.1 is the ten-step path to the goal, true -4.0 is never reaching it."
    )
    return "study table4, appendix panel, last 100 episodes", "; ".join(parts), _verdict(agree, total), why


def brief_ci(s: Summary) -> str:
    """Mean and interval."""
    return f"{number(s.mean)} [{number(s.ci95[0])}, {number(s.ci95[1])}]"


@_claim("F5")
def _f5(e: Evidence) -> _Answer:
    variant = {"UARD-lite": "No sigma_h (UARD-lite)", "Human-only": "No sigma_m (Human-only)", "UARD": "UARD (Full)"}
    parts, agree = [], 0
    for printed in paper.TABLE_5:
        labels = (
            {"variant": variant[printed.variant], "reading": "uard-paper"}
            if printed.discounting
            else {"variant": "Baseline Q-Learning" if printed.variant == "Baseline" else printed.variant}
        )
        s = e.get("table5", "trap_visits", **labels)
        agree += abs(s.mean - printed.visits.mean) <= printed.visits.sd
        parts.append(f"{printed.variant} {brief_ci(s)} (paper {printed.visits.mean:g})")
    why = (
        f"{agree} of 6 rows lie within the printed SD. The order of the single-source rows is the reverse of the printed "
        "one: sigma_h alone avoids the trap, sigma_m alone does nothing, because the heads agree once they have learned."
    )
    return "study table5, the paper's algorithm, visits per episode", "; ".join(parts), _verdict(agree, 6), why


@_claim("I1")
def _i1(e: Evidence) -> _Answer:
    a = e.per_seed("table4", "trap_visits", agent="uard-paper", panel="appendix")
    b = e.per_seed("table4", "trap_visits", agent="baseline", panel="appendix")
    ours, welch = statistics.student(b, a), statistics.welch(b, a)
    table = {r.agent: r for r in paper.TABLE_4}
    spread = (table["Baseline"].visits.sd ** 2 + table["UARD"].visits.sd ** 2) / paper.SEEDS
    t = (table["Baseline"].visits.mean - table["UARD"].visits.mean) / spread**0.5
    printed = paper.TESTS["I1"].t or 0.0
    good = [abs(t - printed) < 0.1, ours.p < 0.001]
    why = f"The difference is significant, but from the printed means and SDs t is {t:.2f}, not {printed}."
    text = (
        f"Student t({ours.df:.0f}) = {ours.t:.1f}, {_p(ours.p)}; Welch t({welch.df:.1f}) = {welch.t:.1f}, {_p(welch.p)}"
    )
    return "study table4: their test and Welch's, over seeds", text, _verdict(sum(good), 2), why


@_claim("I2")
def _i2(e: Evidence) -> _Answer:
    from scipy import stats

    a = e.per_seed("table4", "true_return", agent="uard-paper", panel="appendix")
    b = e.per_seed("table4", "true_return", agent="baseline", panel="appendix")
    mean, ratio = statistics.welch(a, b), a.var(ddof=1) / b.var(ddof=1)
    levene = stats.levene(a, b).pvalue
    good = [mean.p < 0.01, ratio < 1 and levene < 0.01]
    why = (
        "The mean true return is higher. Between seeds its variance is "
        f"{'smaller' if ratio < 1 else 'not smaller'} than the baseline's (ratio {ratio:.2f}, Levene {_p(float(levene))}); "
        "the text does not say which of the two it tests."
    )
    return (
        "study table4: Welch's test of means, Levene's of spread",
        f"means: t = {mean.t:.1f}, {_p(mean.p)}",
        _verdict(sum(good), 2),
        why,
    )


@_claim("I3")
def _i3(e: Evidence) -> _Answer:
    ours = e.per_seed("table3", "trap_visits", agent="uard-paper", horizon=100, panel="main")
    rivals = {
        a: e.per_seed("table3", "trap_visits", agent=a, horizon=100, panel="main") for a in ("baseline", "random walk")
    }
    p = published.packaged()
    for r in p.rows("deep-baselines", horizon=100, mitigation="raw"):
        rivals[r["agent"]] = p.per_seed(r, "trap_visits")
    raw = [statistics.welch(ours, x).p for x in rivals.values()]
    holm, bonferroni = statistics.holm(raw), statistics.bonferroni(raw)
    text = "; ".join(f"{a}: Holm {_p(h)}, Bonferroni {_p(b)}" for a, h, b in zip(rivals, holm, bonferroni, strict=True))
    good = [p < 0.001 for p in bonferroni]
    why = "Significance says nothing of the task: the walker, too, differs from the baseline. Deep baselines where they are published."
    return "study table3: Welch, corrected", text, _verdict(sum(good), 2), why


# --- the filter -------------------------------------------------------------------------------------------------------


def _draws(n: int = 100_000) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    return rng.uniform(0, 20, n), rng.uniform(0, 5, n), rng.uniform(0, 5, n)


@_claim("J1")
def _j1(e: Evidence) -> _Answer:
    mu, sm, sh = _draws()
    wrong = int((ReliabilityFilter().score(mu, sm, sh) < 0).sum())
    return (
        "1e5 random (mu >= 0, sigma_m, sigma_h); property tests",
        f"{wrong} violations",
        _verdict(int(wrong == 0), 1),
        "The denominator is at least 1.",
    )


@_claim("J2")
def _j2(e: Evidence) -> _Answer:
    mu, sm, sh = _draws()
    mu = mu + 0.01
    filter_, blind = ReliabilityFilter(), ReliabilityFilter(alpha=0.0)
    drops = all((filter_.score(mu, sm + a, sh + b) < filter_.score(mu, sm, sh)).all() for a, b in ((0.1, 0), (0, 0.1)))
    flat = bool((blind.score(mu, sm + 0.1, sh) == blind.score(mu, sm, sh)).all())
    why = "Strict for lambda, alpha, beta > 0 only, which the proposition does not ask for: with alpha = 0 J does not move with sigma_m."
    return (
        "1e5 random points, each sigma raised by 0.1",
        f"strict at the defaults: {drops}; flat at alpha = 0: {flat}",
        _verdict(drops + (not flat), 2),
        why,
    )


@_claim("J3")
def _j3(e: Evidence) -> _Answer:
    mu, sm, sh = _draws()
    f = ReliabilityFilter()
    up = float((f.score(-mu - 0.01, sm + 0.1, sh) > f.score(-mu - 0.01, sm, sh)).mean())
    good, bad = f.score(-1.0, 0.1, 0.1), f.score(-1.5, 1.5, 1.5)
    why = f"For mu < 0 J rises with uncertainty: mu = -1.5 with sigmas 1.5 scores {bad:.2f}, above mu = -1 with sigmas 0.1 ({good:.2f})."
    return (
        "1e5 random points with mu < 0",
        f"J rises with sigma_m in {_percent(100 * up)}",
        _verdict(1 + (up == 0), 2),
        why,
    )


@_claim("J4", "J14")
def _j14(e: Evidence) -> _Answer:
    forms = ("reciprocal", "exponential", "linear")
    goal = {f: e.get("filters", "goal_rate", form=f, reading="uard-consistent") for f in forms}
    early = {f: e.window("filters", "trap_visits", 1, 100, form=f, reading="uard-consistent") for f in forms}
    late = {f: e.get("filters", "trap_visits", form=f, reading="uard-consistent") for f in forms}
    worse = [
        goal[f].ci95[1] < goal["reciprocal"].ci95[0] or late[f].ci95[0] > late["reciprocal"].ci95[1] for f in forms[1:]
    ]
    text = "; ".join(
        f"{f}: goal {brief_ci(goal[f])}, visits {brief_ci(late[f])}, first 100 episodes {brief_ci(early[f])}"
        for f in forms
    )
    why = f"{sum(worse)} of the two alternatives do worse than the reciprocal form (intervals apart) where the backup is repaired."
    return "study filters, 6x6, main panel, consistent backup", text, _verdict(sum(worse), 2), why


@_claim("J5")
def _j5(e: Evidence) -> _Answer:
    ratio, live = theory.contraction(), theory.live_expansion()
    gamma = paper.GAMMA
    why = f"True while weights are frozen (at most {ratio:.4f} over 1000 pairs per grid). With w = w(sigma_m(Q)), which is what an agent has, the ensemble map drives two tables apart by a factor {live:.2f}."
    return (
        "T_lambda on the paper's grids, random pairs; ensemble map with live weights",
        f"frozen {ratio:.4f}, live {live:.2f}",
        _verdict((ratio <= gamma + 1e-9) + (live <= gamma), 2),
        why,
    )


@_claim("J6")
def _j6(e: Evidence) -> _Answer:
    spread = theory.fixed_point_spread()
    return (
        "value iteration from 20 random starts, weights frozen",
        f"largest difference {spread:.1e}",
        _verdict((spread < 1e-6) + 0, 2),
        "Unique while weights are frozen; nothing is proved, and nothing holds (J5), for weights that follow Q.",
    )


@_claim("J7")
def _j7(e: Evidence) -> _Answer:
    table = theory.critical_lambdas()
    hacks = [t for t in table if t.critical is None or t.critical > paper.LAMBDA]
    shown = "; ".join(
        f"{t.size}x{t.size} {t.trap:+g} {t.panel}: {'none' if t.critical is None else number(t.critical)}"
        for t in table
        if t.trap == 4
    )
    why = f"At lambda = 2 the fixed point still hacks in {len(hacks)} of {len(table)} cases (grid, trap, raters); with the appendix raters no lambda stops it."
    return "critical lambda of T_lambda by value iteration", shown, _verdict(len(table) - len(hacks), len(table)), why


@_claim("J8")
def _j8(e: Evidence) -> _Answer:
    return (
        "-",
        "-",
        UNTESTABLE,
        "alpha_m and alpha_h are not defined, and no bias or variance is reported that they could trade.",
    )


@_claim("J9")
def _j9(e: Evidence) -> _Answer:
    up = theory.hazard()
    why = f"For positive rewards yes. A hazard of {up.reward:g} is avoided without the filter and entered with it (lambda = {up.lam:g}): a weight below 1 makes a penalty smaller, which is optimism."
    return (
        "fixed points on a corridor with a hazard",
        f"enters at lambda 0: {up.enters_without}; at {up.lam:g}: {up.enters_with}",
        _verdict(1 + (not up.enters_with), 2),
        why,
    )


@_claim("J10")
def _j10(e: Evidence) -> _Answer:
    _, u, v = _draws()
    lam = paper.LAMBDA
    w, x = reciprocal_weight(u, lam), reciprocal_weight(v, lam)
    good = [bool((w > 0).all()), bool((w <= 1).all()), reciprocal_weight(0.0, lam) == 1.0]
    good += [bool(((u < v) == (w > x))[u != v].all()), bool((np.abs(w - x) <= lam * np.abs(u - v) + 1e-12).all())]
    return "1e5 random pairs; property tests", f"{sum(good)} of 5 properties", _verdict(sum(good), 5), "Elementary."


@_claim("J11")
def _j11(e: Evidence) -> _Answer:
    u, mu = 1.0, 2.0
    derived, used = reciprocal_weight(paper.LAMBDA * u * u / (2 * mu), 1.0), reciprocal_weight(u, paper.LAMBDA)
    why = "1/(1+z) is put in place of the derived 1-z 'to preserve positivity', then z = kappa U^2 / (2 mu) is replaced by lambda U. Two of the three steps are choices."
    return (
        "the derivation, with kappa = lambda = 2, U = 1, mu = 2",
        f"derived form {derived:.3f}, used form {used:.3f}",
        _verdict(1, 3),
        why,
    )


@_claim("J12")
def _j12(e: Evidence) -> _Answer:
    _, u, _ = _draws(1000)
    same = float(np.abs(wiener_weight(np.ones_like(u), paper.LAMBDA * u) - reciprocal_weight(u, paper.LAMBDA)).max())
    return (
        "identity on 1000 points",
        f"largest difference {same:.1e}",
        IN_PART if same < 1e-9 else FAILS,
        "The filter is a Wiener gain if the ratio of noise to signal power is taken to be lambda U (a deviation, not a power). For the Information Bottleneck there is no derivation.",
    )


@_claim("J13")
def _j13(e: Evidence) -> _Answer:
    def slopes(x: float) -> tuple[float, float]:
        return float(np.exp(-x)), 1 / (1 + x) ** 2

    x = paper.LAMBDA * paper.BETA * paper.SIGMA_H_AT_TRAP
    exponential, reciprocal = slopes(x)
    from scipy.optimize import brentq

    root: Any = brentq(lambda z: slopes(z)[0] - slopes(z)[1], 1.0, 5.0)
    crossing = float(root)
    why = f"Only above lambda U = {crossing:.3f}. At the paper's own trap (lambda U = {x:.3f}) the exponential filter has the larger slope."
    return (
        "slopes of both filters (G2)",
        f"at the trap: exponential {exponential:.3f}, reciprocal {reciprocal:.3f}",
        _verdict((reciprocal > exponential) + 1, 2),
        why,
    )


@_claim("J15")
def _j15(e: Evidence) -> _Answer:
    gap = [
        e.get("matrix", "trap_visits", mitigation="mean-of-annotations", size=6, trap=4.0, panel="appendix", noise=0.0)
    ]
    why = "The learner never reads R*, and a test proves that changing it alone changes nothing. But the ratings are centred on R*: with the appendix panel the mean rating alone, without any filter, solves the grid, and the erratic rater is keyed on the trap itself."
    return (
        "independence test; learning from the mean rating, 6x6, appendix",
        f"visits {full(gap[0])}",
        _verdict(1 + (gap[0].mean > 1), 2),
        why,
    )


# --- hacking ----------------------------------------------------------------------------------------------------------


@_claim("J16")
def _j16(e: Evidence) -> _Answer:
    base, ours, walker = (
        e.get("table3", "trap_visits", agent=a, horizon=100, panel="main")
        for a in ("baseline", "uard-paper", "random walk")
    )
    goal = e.get("table3", "goal_rate", agent="uard-paper", horizon=100, panel="main")
    reached = _reduction(ours, base)
    printed = paper.PERCENT["hacking"].value
    good = [reached >= printed, goal.mean > 0.5, False]
    why = f"On the grid the number is reached, and means little: a random walker has {_percent(_reduction(walker, base))}, and UARD as printed reaches the goal in {_percent(100 * goal.mean)} of episodes. {_on_mujoco()}"
    return (
        "study table3, T = 100, main panel",
        f"{_percent(reached)} ({full(ours)} against {full(base)})",
        _verdict(sum(good), 3),
        why,
    )


def _on_mujoco() -> str:
    p = published.packaged()
    judged = [
        (r, x) for r in p.rows(locomotion.HACKING, mitigation="uard") if (x := locomotion.shares(p, r)[0]) is not None
    ]
    judged = [(r, x) for r, x in judged if r["region"] != "none"]
    if not judged:
        return "MuJoCo: not published."
    good = sum(x >= locomotion.REMOVED for _, x in judged)
    return f"MuJoCo: the repaired uard removes that share of the raw agent's hacks in {good} of {len(judged)} settings, at least {_percent(100 * min(x for _, x in judged))}."


@_claim("J17")
def _j17(e: Evidence) -> _Answer:
    base = e.get("table4", "trap_visits", agent="baseline", panel="main")
    ours = {p: e.get("table4", "trap_visits", agent="uard-paper", panel=p) for p in ("main", "appendix")}
    printed = paper.PERCENT["visits-6x6"].value
    good = [_reduction(s, base) >= printed for s in ours.values()]
    text = "; ".join(f"{p}: {_percent(_reduction(s, base))}, {full(s)}" for p, s in ours.items())
    return "study table4, visits per episode", text, _verdict(sum(good), 2), "See J30 for what it costs."


@_claim("J18")
def _j18(e: Evidence) -> _Answer:
    parts, good = [], []
    for size, name in ((8, "hits-8x8"), (10, "hits-10x10")):
        base, ours = (
            e.get("scale", "trap_visits", agent=a, size=size, panel="main") for a in ("baseline", "uard-paper")
        )
        good.append(_reduction(ours, base) >= paper.PERCENT[name].value)
        parts.append(f"{size}x{size}: {_percent(_reduction(ours, base))}")
    return (
        "study scale, main panel",
        "; ".join(parts),
        _verdict(sum(good), 2),
        "The reductions are at least as large; the counts behind the printed ones are not those of this grid (F2).",
    )


@_claim("J19")
def _j19(e: Evidence) -> _Answer:
    base, ours = (e.get("table4", "alignment_gap", agent=a, panel="appendix") for a in ("baseline", "uard-paper"))
    uard = next(r for r in paper.TABLE_4 if r.agent == "UARD")
    implied = abs(uard.observed_return.mean - uard.true_return.mean)
    own = 100 * (1 - implied / paper.TEXT["baseline gap"].value)
    good = [_reduction(ours, base) >= 90, abs(own - paper.PERCENT["gap"].value) < 1]
    why = f"The gap shrinks, but from the paper's own returns (9.1 and -4.0) it would be {implied:.1f}, a reduction of {_percent(own)}."
    return (
        "study table4, appendix panel, |observed - true| per episode",
        f"{full(base)} to {full(ours)}: {_percent(_reduction(ours, base))}",
        _verdict(sum(good), 2),
        why,
    )


@_claim("J20")
def _j20(e: Evidence) -> _Answer:
    base, ours = (
        e.curves("table4", "true_return", agent=a, panel="main")[:, -100:].std(1, ddof=1)
        for a in ("baseline", "uard-paper")
    )
    better = statistics.summarise(100 * (1 - ours / base))
    low, level = paper.FIGURES["G8"].numbers["baseline"][0], paper.FIGURES["G8"].numbers["UARD"]  # type: ignore[index]
    printed = paper.PERCENT["stability"].value
    why = f"The printed number is 1 - {abs(level):g}/{abs(low):g}: a level divided by another curve's worst point, no measure of stability."  # type: ignore[arg-type]
    return (
        "study table4: SD of the true return over the last 100 episodes, per seed",
        f"SD falls by {brief_ci(better)} %",
        _verdict(int(abs(better.mean - printed) < 5), 1),
        why,
    )


_NO_MUJOCO = "-", "-", UNTESTABLE, "Its rows are not among the published results: uard reproduce mujoco-standard."


def _noisy(share: float, mitigation: str) -> np.ndarray | None:
    """Return violations per episode of PPO on Hopper, one number per seed; None if they are not published."""
    p = published.packaged()
    rows = p.rows(locomotion.NOISE, agent="ppo", mitigation=mitigation, noise=share)
    return p.per_seed(rows[0], "trap_visits") if rows else None


_NOISY = "study mujoco-standard-noise: PPO, Hopper, vibration, main panel, steps in the region per episode"
_DEAF = "Raw PPO reads no ratings, so the raters' noise cannot reach it; what noise the paper's baselines met it does not say."


@_claim("J21")
def _j21(e: Evidence) -> _Answer:
    raw, noisy, ours = _noisy(0.0, "raw"), _noisy(0.3, "raw"), _noisy(0.3, "uard")
    if raw is None or noisy is None or ours is None:
        return _NO_MUJOCO
    rise, cut = noisy.mean() / max(raw.mean(), 1e-9) - 1, 1 - ours.mean() / max(noisy.mean(), 1e-9)
    before, after, filtered = (brief_ci(statistics.summarise(x)) for x in (raw, noisy, ours))
    text = f"raw {before} at 0 %, {after} at 30 %; uard {filtered} at 30 %, {_percent(100 * cut)} lower"
    return _NOISY, text, _verdict((rise >= 2.77) + (cut >= 0.983), 2), _DEAF


@_claim("J45")
def _j45(e: Evidence) -> _Answer:
    noisy = _noisy(0.3, "raw")
    if noisy is None:
        return _NO_MUJOCO
    return _NOISY, f"worst of {len(noisy)} seeds: {number(noisy.max())}", _verdict(int(noisy.max() > 40), 1), _DEAF


@_claim("J36")
def _j36(e: Evidence) -> _Answer:
    p = published.packaged()
    rows = p.rows(locomotion.HACKING, robot="walker2d", agent="ppo", mitigation="true reward")
    if not rows:
        return _NO_MUJOCO
    returns = [p.of(r, "true_return") for r in rows]
    text = "; ".join(f"{r['region']}: {full(s)}" for r, s in zip(rows, returns, strict=True))
    why = (
        "A robot that does nothing scores 95, and 110 is a fall after about 113 steps. Trained on the true reward, with "
        "nothing to exploit, it returns far more: 350 is no sign of exploiting."
    )
    return (
        "study mujoco-standard-hacking: PPO on the true reward",
        text,
        _verdict(int(returns[0].ci95[0] < 115), 1),
        why,
    )


def _distorted(name: str) -> dict[str, Summary] | None:
    """Return something of the distortion study by agent; None if it is not published."""
    p = published.packaged()
    rows = p.rows("deep-distortion")
    if len(rows) < 3:
        return None
    return {r["agent"]: statistics.summarise(p.derived(r, name)) for r in rows}


_UNPUBLISHED = "-", "-", UNTESTABLE, "Its study is not among the published results: uard reproduce grid-deep."
_DISTORTED = "study deep-distortion: +1.5 on the reward for 60 of 1000 steps; definitions are ours, the paper has none"
_UNEQUAL = "EDAC and SUNRISE read no ratings and cannot know of the lie, so it is no fair fight."


def _on_hopper() -> str:
    """Say how many exploit activations the same study counts in MuJoCo, if it is published."""
    p = published.packaged()
    counts = [
        f"{r['agent']}, critics {r['critics']}: {brief_ci(statistics.summarise(p.derived(r, 'reaction')[:, 0]))}"
        for r in p.rows(locomotion.DISTORTION)
    ]
    return f" On Hopper (mujoco-standard-distortion), of 60: {'; '.join(counts)}." if counts else ""


@_claim("J22")
def _j22(e: Evidence) -> _Answer:
    count = _distorted("activations")
    if count is None:
        return _UNPUBLISHED
    cut = 100 * (1 - count["uard"].mean / count["edac"].mean) if count["edac"].mean else 0.0
    text = f"uard {brief_ci(count['uard'])}, EDAC {brief_ci(count['edac'])} activations: {_percent(cut)} fewer"
    return _DISTORTED, text, _verdict(int(cut >= 92.0), 1), _UNEQUAL + _on_hopper()


@_claim("J23")
def _j23(e: Evidence) -> _Answer:
    largest = _distorted("largest")
    if largest is None:
        return _UNPUBLISHED
    ours, theirs = max(largest["uard"].mean, 1e-9), largest["sunrise"].mean
    text = f"largest adjusted reward: SUNRISE {brief_ci(largest['sunrise'])}, uard {brief_ci(largest['uard'])}"
    return _DISTORTED, text, _verdict(int(theirs > 5 * ours), 1), _UNEQUAL


@_claim("J44")
def _j44(e: Evidence) -> _Answer:
    mean, largest = _distorted("mean_inside"), _distorted("largest")
    if mean is None or largest is None:
        return _UNPUBLISHED
    good = [mean["edac"].mean - mean["uard"].mean > 0.1, largest["uard"].mean < 0.3]
    text = f"EDAC exceeds uard by {number(mean['edac'].mean - mean['uard'].mean)} in the windows; uard's largest is {brief_ci(largest['uard'])}"
    return _DISTORTED, text, _verdict(sum(good), 2), _UNEQUAL


@_claim("J24")
def _j24(e: Evidence) -> _Answer:
    tabled = len(paper.TABLE_3) - 1
    ran = {r["agent"] for r in published.packaged().rows("deep-baselines", mitigation="raw")} - {"cpo-oracle"}
    return (
        "count of the paper's tables; ours in study deep-baselines",
        f"{tabled} of 9 in a table; we ran {len(ran)}",
        _verdict(tabled, 9),
        "Four more appear in figures only, Ensemble-DQN nowhere.",
    )


@_claim("J25")
def _j25(e: Evidence) -> _Answer:
    parts, calm, flat = [], [], []
    for unit in ("reward units", "of the trap's reward"):
        for panel in ("main", "appendix"):
            clean = e.get("noise", "trap_visits", agent="uard-paper", panel=panel, percent=0, unit=unit)
            noisy = e.get("noise", "trap_visits", agent="uard-paper", panel=panel, percent=30, unit=unit)
            base = e.get("noise", "trap_visits", agent="baseline", panel=panel, percent=30, unit=unit)
            calm.append(noisy.mean < 1)
            flat.append(base.mean > 15)
            parts.append(f"{panel}, 30 % {unit}: {brief_ci(noisy)} (0 %: {brief_ci(clean)})")
    why = f"UARD as printed stays below one visit in {sum(calm)} of 4 settings. The baselines cannot degrade with the raters' noise: they read no ratings (J35), and here they hack at every level."
    return "study noise, 6x6, visits per episode of uard-paper", "; ".join(parts), _verdict(sum(calm), 5), why


@_claim("J26")
def _j26(e: Evidence) -> _Answer:
    late = {p: e.window("table4", "goal", 401, 500, agent="uard-paper", panel=p) for p in ("main", "appendix")}
    ours = e.curves("table4", "goal", agent="uard", panel="main").mean(0)
    smooth = np.convolve(ours, np.ones(10) / 10, "valid")
    first = int(np.argmax(smooth > 0.5)) + 10 if (smooth > 0.5).any() else 0
    text = "; ".join(f"{p}: goal in {brief_ci(s)} of episodes 401-500" for p, s in late.items())
    why = f"As printed it never turns to the goal. The repaired `uard` does, without a delay: half of its episodes end there from about episode {first}."
    return "study table4, uard-paper", text, _verdict(sum(s.mean > 0.5 for s in late.values()), 2), why


@_claim("J27")
def _j27(e: Evidence) -> _Answer:
    visits = {p: e.window("table4", "trap_visits", 200, 500, agent="uard-paper", panel=p) for p in ("main", "appendix")}
    true = {p: e.window("table4", "true_return", 200, 500, agent="uard-paper", panel=p) for p in ("main", "appendix")}
    good = [s.mean < 1 for s in visits.values()] + [abs(s.mean + 4) < 0.6 for s in true.values()]
    text = "; ".join(f"{p}: visits {brief_ci(visits[p])}, true return {brief_ci(true[p])}" for p in visits)
    return (
        "study table4, uard-paper, episodes 200-500",
        text,
        _verdict(sum(good), 4),
        "Stable at about -4: forty steps of -0.1 without reaching the goal.",
    )


@_claim("J28")
def _j28(e: Evidence) -> _Answer:
    base = {n: e.get("scale", "trap_visits", agent="baseline", size=n, panel="main") for n in (6, 8, 10)}
    length = {n: e.get("scale", "episode_length", agent="baseline", size=n, panel="main") for n in (6, 8, 10)}
    goal = {n: e.get("scale", "goal_rate", agent="uard-paper", size=n, panel="main") for n in (6, 8, 10)}
    share = {n: base[n].mean / length[n].mean for n in base}
    text = "; ".join(f"{n}x{n}: {brief_ci(base[n])} visits, {share[n]:.2f} per step" for n in base)
    good = [
        base[6].mean < base[8].mean < base[10].mean,
        max(share.values()) - min(share.values()) > 0.1,
        min(g.mean for g in goal.values()) > 0.5,
    ]
    return (
        "study scale, main panel, baseline",
        text,
        _verdict(sum(good), 3),
        "Visits grow because episodes are longer; per step they do not. UARD as printed reaches the goal on no grid.",
    )


@_claim("J29")
def _j29(e: Evidence) -> _Answer:
    ours, walker, best = (
        e.get("table3", "observed_return", agent=a, horizon=100, panel="main")
        for a in ("uard-paper", "random walk", "uard")
    )
    printed = paper.TABLE_3[-1].reward.mean
    why = f"A random walker, too, earns about as much as the printed {printed:g} ({number(walker.mean)} here), and UARD as printed less; the repaired `uard` earns {number(best.mean)} on the same grid with the same ratings."
    return (
        "study table3, T = 100, observed return",
        f"uard-paper {full(ours)}; random walk {full(walker)}; uard {full(best)}",
        _verdict(int(ours.mean > 0.5 * best.mean), 1),
        why,
    )


@_claim("J30")
def _j30(e: Evidence) -> _Answer:
    cells = [(n, p) for n in (6, 8, 10) for p in ("main", "appendix")]
    paper_goal = {c: e.get("scale", "goal_rate", agent="uard-paper", size=c[0], panel=c[1]) for c in cells}
    ours = {c: e.get("scale", "goal_rate", agent="uard", size=c[0], panel=c[1]) for c in cells}
    text = "; ".join(f"{n}x{n} {p}: {brief_ci(paper_goal[n, p])}" for n, p in cells)
    why = f"As printed it hovers beside the trap. The repaired `uard` reaches the goal in at least {_percent(100 * min(s.mean for s in ours.values()))} on the same grids."
    return (
        "study scale, goal rate of uard-paper",
        text,
        _verdict(sum(s.mean > 0.5 for s in paper_goal.values()), len(cells)),
        why,
    )


@_claim("J31")
def _j31(e: Evidence) -> _Answer:
    base = e.per_seed("table5", "trap_visits", variant="Baseline Q-Learning")
    tests = {
        v: statistics.welch(base, e.per_seed("table5", "trap_visits", variant=v)) for v in ("Ablation I", "Ablation II")
    }
    corrected = statistics.holm([t.p for t in tests.values()])
    text = "; ".join(
        f"{v}: {t.difference:+.2f} visits, Holm {_p(p)}" for (v, t), p in zip(tests.items(), corrected, strict=True)
    )
    small = [abs(t.difference) < 2.7 for t in tests.values()]
    return (
        "study table5, difference from the baseline",
        text,
        _verdict(sum(small), 2),
        "Knowing the uncertainty without using it changes nothing here, less than the paper's 2.7 visits.",
    )


@_claim("J32")
def _j32(e: Evidence) -> _Answer:
    v = {
        n: e.get("table5", "trap_visits", variant=n, reading="uard-paper")
        for n in ("No sigma_h (UARD-lite)", "No sigma_m (Human-only)", "UARD (Full)")
    }
    lite, human, both = v.values()
    good = [human.mean > 2 * both.mean and human.mean > 2, lite.mean > 2 * both.mean]
    why = "sigma_h alone does what both do; sigma_m alone does nothing. The printed order (lite better than human-only) is reversed."
    return (
        "study table5, the paper's algorithm",
        "; ".join(f"{n}: {brief_ci(s)}" for n, s in v.items()),
        _verdict(sum(good), 2),
        why,
    )


@_claim("J33")
def _j33(e: Evidence) -> _Answer:
    runs = e.results(e.row("uncertainty", agent="uard-paper", panel="main", heads="bootstrapped").cell)
    curves = np.stack([r.extra["uncertainty"] for r in runs]).astype(float)
    peak, end = statistics.summarise(curves[:, :, 0].max(1)), statistics.summarise(curves[:, -1, 0])
    human, elsewhere = statistics.summarise(curves[:, -1, 2]), statistics.summarise(curves[:, -1, 3])
    lite = e.get("table5", "trap_visits", variant="No sigma_h (UARD-lite)", reading="uard-paper")
    good = [end.mean < 0.5 * peak.mean, human.mean > 5 * elsewhere.mean, lite.mean > 1]
    why = "sigma_m at the trap falls and sigma_h stays. But as sigma_m falls the weight of the trap rises: what is avoided is avoided by sigma_h alone."
    text = f"sigma_m at the trap {brief_ci(peak)} at its peak, {brief_ci(end)} at the end; sigma_h {brief_ci(human)}, elsewhere {brief_ci(elsewhere)}"
    return "study uncertainty, uard-paper, main panel, bootstrapped heads", text, _verdict(sum(good), 3), why


@_claim("J34")
def _j34(e: Evidence) -> _Answer:
    def at(lam: float, metric: str = "trap_visits") -> Summary:
        return e.get("sensitivity", metric, reading="uard-consistent", size=6, lam=lam)

    good = [
        at(1.0).ci95[0] > at(2.0).ci95[1],
        at(5.0).mean < 1,
        at(50.0, "goal_rate").ci95[1] < at(2.0, "goal_rate").ci95[0],
    ]
    text = "; ".join(
        f"lambda {x:g}: visits {brief_ci(at(x))}, goal {at(x, 'goal_rate').mean:.2f}"
        for x in (0.0, 1.0, 2.0, 5.0, 20.0, 50.0)
    )
    why = f"{sum(good)} of 3 parts: more hacking below 2, none at 5, over-caution far above 10 (6x6, consistent backup: as printed the goal is never reached, whatever lambda)."
    return "study sensitivity", text, _verdict(sum(good), 3), why


@_claim("J35")
def _j35(e: Evidence) -> _Answer:
    return (
        "-",
        "-",
        UNTESTABLE,
        "Their code is not public. By the text only UARD receives ratings, and one rater is keyed on the trap, which no baseline sees. Here all agents share environments, seeds, budgets and the observed reward; baselines that read the same ratings are in the study matrix.",
    )


@_claim("J37")
def _j37(e: Evidence) -> _Answer:
    if speed := published.packaged_json("speed.json"):
        cost = {row["name"]: row["cost_of_single"] for row in speed["rows"]}
        full, shared = cost["5 full networks"], cost["5 heads, shared trunk"]
        text = f"5 full networks {full:.2f}, 5 heads on a shared trunk {shared:.2f} times a single network"
        why = "A matter of code, not of method: an ensemble that shares its trunk is cheap, independent networks cost their arithmetic."
        good = [2 <= full <= 3, 2 <= shared <= 3]
        return "benchmarks/deep.py: DQN on 10x10, one core, per step", text, _verdict(sum(good), 2), why
    return (
        "-",
        "-",
        UNTESTABLE,
        "A matter of code, not of method; benchmarks/deep.py measures ours, and its numbers are not among the published results.",
    )


@_claim("J38")
def _j38(e: Evidence) -> _Answer:
    rows = list(e.studies["abstention"].rows)
    solved = [r for r in rows if e.of(r.cell, "trap_visits").mean < 0.5 and e.of(r.cell, "goal_rate").mean > 0.9]
    best = max(rows, key=lambda r: e.of(r.cell, "true_return").mean)
    none = e.get("abstention", "true_return", rule="none")
    text = f"best: {best['rule']} {best['limit']:g}, {best['response']}: true return {full(e.of(best.cell, 'true_return'))} (none: {brief_ci(none)})"
    why = f"The paper shows no result. Of our {len(rows) - 1} settings {len(solved)} solve the grid (visits < 0.5 and goal > 0.9) when added to the paper's agent."
    return "study abstention, 6x6", text, _verdict(len(solved), len(rows) - 1), why


@_claim("J39")
def _j39(e: Evidence) -> _Answer:
    def worst(variant: str) -> float:
        return max(e.of(r.cell, "trap_visits").mean for r in e.studies["settings"].where(variant=variant))

    adaptive, static, strong = worst("as recommended"), worst("kappa 0 (not adaptive)"), worst("lam 2, kappa 0")
    good = [adaptive < 0.5, static > 1, strong > 1]
    why = "The paper gives no law for lambda_t; with ours, the adaptive form avoids the traps in every setting and constant lambda does not. Only the grid part of the claim is tested."
    text = f"worst case over settings: adaptive {number(adaptive)}, constant lambda 0.2: {number(static)}, constant lambda 2: {number(strong)} visits"
    return "study settings, 10x10, both panels, +4 and +8, noise 0 and 1.2", text, _verdict(sum(good), 3), why


@_claim("J40", "J41")
def _j40(e: Evidence) -> _Answer:
    radii = theory.radii()
    text = "; ".join(f"{r.definition}: raw {r.raw:.2f}, filtered {r.filtered:.2f}" for r in radii)
    wider = [r.filtered > r.raw + 1e-9 for r in radii]
    why = f"The filtered agent's radius is larger under {sum(wider)} of three definitions and smaller under {sum(r.filtered < r.raw - 1e-9 for r in radii)}. The text says both, of one undefined quantity."
    return (
        "sign-preservation radius at the trap's edge, 6x6, three definitions",
        text,
        IN_PART if any(wider) and not all(wider) else _verdict(sum(wider), 3),
        why,
    )


@_claim("J42")
def _j42(e: Evidence) -> _Answer:
    return "-", "-", UNTESTABLE, "A claim of priority, not of fact about agents."


@_claim("J43")
def _j43(e: Evidence) -> _Answer:
    return (
        "cross-references of the source",
        "no such section",
        FAILS,
        "Section 5.5 describes the noise setup; alpha and beta are never varied. See study settings for ours.",
    )
