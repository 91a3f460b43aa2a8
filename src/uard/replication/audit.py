"""The paper's arithmetic, recomputed: what its own numbers imply, and where they contradict each other.

Every number comes from ``uard.replication.paper`` or is computed here, exactly where that is possible (value iteration, Markov
chains, quadrature). One function per section of ``paper/audit.md``; ``run`` does all in a few seconds.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy import stats

from uard.envs.grids.trapgrid import TrapGrid, paper_grid
from uard.envs.tables import Task
from uard.method import bellman
from uard.method.stability import sign_preservation_radius
from uard.method.weights import Form, reciprocal_weight
from uard.replication import paper
from uard.replication.paper import Stat

Values = dict[str, float | str | None]
SIZES = (6, 8, 10)
TABLE_3_HORIZON = 100  # what section a finds


@dataclass(frozen=True)
class Check:
    """One question put to the paper, and the answer.

    Attributes:
        id: Section of the audit and a name, e.g. ``a.horizon``.
        question: What is asked.
        paper: What the paper prints, by name; empty where it prints nothing.
        recomputed: What comes out here, by name.
        verdict: The answer in a few words.
        holds: Whether what the paper says follows; None where it says nothing to hold or fail.
        concerns: Ids of the inventory (claims J, tables F, figures G...).
    """

    id: str
    question: str
    paper: Mapping[str, float | str | None]
    recomputed: Mapping[str, float | str | None]
    verdict: str
    holds: bool | None
    concerns: tuple[str, ...]


class Outcome(NamedTuple):
    """Exact moments of one episode from the start, per policy: arrays of shape (P,)."""

    visits: np.ndarray
    visits_variance: np.ndarray
    goal_rate: np.ndarray
    observed_return: np.ndarray


def episode_outcome(grid: TrapGrid, policy: np.ndarray, epsilon: np.ndarray | float = 0.0) -> Outcome:
    """Return the exact outcome of an epsilon-greedy policy within the grid's horizon, by a backward Markov chain.

    Args:
        grid: The grid.
        policy: (S, A) action probabilities of the greedy part.
        epsilon: (P,) probabilities in [0, 1] of a uniformly random action; one policy per entry.
    """
    task = grid.task()
    eps = np.atleast_1d(np.asarray(epsilon, float))
    share = 1.0 / policy.shape[1]
    steps = [
        (
            (1.0 - eps) * policy[:, [a]] + eps * share,
            task.next_state[:, a],
            *(np.asarray(table, float)[:, [a]] for table in (~task.terminal, grid.truth().hack, task.reward)),
        )
        for a in range(policy.shape[1])
    ]
    first = second = goal = total = np.zeros((len(policy), len(eps)))
    for _ in range(int(task.horizon)):
        now = [0.0, 0.0, 0.0, 0.0]
        for chance, entered, goes_on, hack, reward in steps:
            onwards = goes_on * first[entered]
            now[0] += chance * (hack + onwards)
            now[1] += chance * (hack * (1.0 + 2.0 * onwards) + goes_on * second[entered])
            now[2] += chance * (1.0 - goes_on + goes_on * goal[entered])
            now[3] += chance * (reward + goes_on * total[entered])
        first, second, goal, total = (np.asarray(x) for x in now)
    s = int(task.start)
    return Outcome(first[s], second[s] - first[s] ** 2, goal[s], total[s])


def most_visits(grid: TrapGrid) -> int:
    """Return the largest number of trap visits that any policy can make in one episode (backward induction)."""
    task, hack = grid.task(), np.asarray(grid.truth().hack, float)
    best = np.zeros(len(hack))
    for _ in range(int(task.horizon)):
        best = (hack + np.where(task.terminal, 0.0, best[task.next_state])).max(1)
    return round(float(best[int(task.start)]))


# Quadrature over a Rayleigh variable: midpoints v of [0, 1] with P(R < radius) = v^2, so that R grows like v near 0.
_V = (np.arange(200) + 0.5) / 200
_RAYLEIGH, _MASS = np.sqrt(-2.0 * np.log1p(-(_V**2))), _V / _V.sum()


class RaterSpread:
    """sigma_h of three raters with independent normal errors and no bias: exact by quadrature over an angle.

    The errors' deviations from their mean live in a plane, so sigma_h = R sqrt(g(angle)) with R Rayleigh-distributed
    and the angle uniform.

    Attributes:
        g: (angles,) squared scale at each angle.
    """

    def __init__(self, deviations: tuple[float, ...], ddof: int, angles: int = 64):
        """Take the raters' standard deviations and the ddof of sigma_h."""
        size = len(deviations)
        centring = np.eye(size) - 1.0 / size
        scales = np.diag(deviations)
        high, low = np.linalg.eigvalsh(scales @ centring @ scales)[::-1][:2]
        angle = (np.arange(angles) + 0.5) * (math.pi / 2 / angles)
        self.g = (high * np.cos(angle) ** 2 + low * np.sin(angle) ** 2) / (size - ddof)

    def mean(self) -> float:
        """E sigma_h."""
        return math.sqrt(math.pi / 2) * float(np.sqrt(self.g).mean())

    def exceeds(self, threshold: float) -> float:
        """P(sigma_h >= threshold)."""
        return float(np.exp(-(threshold**2) / (2.0 * self.g)).mean())

    def below(self, other: RaterSpread) -> float:
        """P(a draw of this spread < an independent draw of the other)."""
        return float((other.g / (other.g + self.g[:, None])).mean())

    def mean_weight(self, lam: float, beta: float = paper.BETA) -> float:
        """E w over fresh draws, for the reciprocal filter."""
        weight = reciprocal_weight(np.sqrt(self.g)[:, None] * _RAYLEIGH, lam * beta)
        return float((weight @ _MASS).mean())


def bisect(function: Callable[[float], float], low: float, high: float, rounds: int = 60) -> float:
    """Return the zero of a function with a change of sign in [low, high]."""
    rising = function(low) < 0
    for _ in range(rounds):
        middle = (low + high) / 2.0
        if (function(middle) < 0) == rising:
            low = middle
        else:
            high = middle
    return (low + high) / 2.0


def _solved(grid: TrapGrid, weight: float | np.ndarray = 1.0, reward: np.ndarray | None = None) -> np.ndarray:
    task = grid.task()
    r = np.asarray(task.reward if reward is None else reward, float)
    return bellman.solve(r, weight, task.next_state, task.terminal, paper.GAMMA)


def _walk(grid: TrapGrid, scores: np.ndarray) -> tuple[bellman.GreedyPath, str]:
    path = bellman.greedy_path(scores, grid.task(), grid.truth().hack)
    return path, f"{path.total_visits} visits, {'goal' if path.reached_goal else 'no goal'}"


def _at_traps(grid: TrapGrid, there: float, elsewhere: float = 0.0) -> np.ndarray:
    return np.where(grid.truth().hack, there, elsewhere)


def annotator_sigmas() -> dict[str, tuple[float, float]]:
    """Return sigma_h at traps and elsewhere of the readings of the annotators (means over fresh draws)."""
    readings = {
        "main, population SD": (paper.SIGMA_H_AT_TRAP, 0.0),
        "main, sample SD": (float(np.std((-1, 2, 1), ddof=1)), 0.0),
    }
    for ddof in (0, 1):
        trap, elsewhere = (RaterSpread(sd, ddof).mean() for sd in paper.APPENDIX_RATER_SD.values())
        readings[f"appendix, ddof {ddof}"] = (trap, elsewhere)
    return readings


def _consistent(grid: TrapGrid, denominator: np.ndarray) -> tuple[np.ndarray, float]:
    """Values whose backup follows argmax J (reading R5), and the last residual."""
    task = grid.task()
    reward, onwards = np.asarray(task.reward, float), np.where(task.terminal, 0.0, paper.GAMMA)
    q, rows, residual = np.zeros_like(reward), np.arange(len(reward)), math.inf
    for _ in range(1000):
        new = reward + onwards * q[rows, (q / denominator).argmax(1)][task.next_state]
        residual, q = float(np.abs(new - q).max()), new
        if residual < 1e-9:
            break
    return q, residual


def readings() -> list[Check]:
    """Section 0: where the filter acts decides what the agent does; the paper does not say where."""
    verdicts = {
        "main, population SD": "T_lambda, the operator of Theorem 1, hacks on every grid; acting on J with an ordinary "
        "backup avoids the trap and hovers for ever; only backing up the value of J's own action avoids and arrives",
        "appendix, ddof 0": "T_lambda hacks on every grid, and whatever acts on J hovers for ever",
    }
    return [_reading(name, verdict) for name, verdict in verdicts.items()]


def _reading(name: str, verdict: str) -> Check:
    trap, elsewhere = annotator_sigmas()[name]
    table: Values = {}
    for size in SIZES:
        grid = paper_grid(size)
        weight = reciprocal_weight(paper.BETA * _at_traps(grid, trap, elsewhere), paper.LAMBDA)
        raw = _solved(grid)
        consistent, residual = _consistent(grid, 1.0 / weight)
        hovering, hovers = _walk(grid, raw * weight)
        settles = "" if residual < 1e-9 else ", values do not settle"
        table |= {
            f"{size}, raw": _walk(grid, raw)[1],
            f"{size}, T_lambda": _walk(grid, _solved(grid, weight))[1],
            f"{size}, acts on J": hovers,
            f"{size}, acts on J: true return": round(paper.STEP_REWARD * len(hovering.actions), 6),
            f"{size}, backs up J's action": _walk(grid, consistent * weight)[1] + settles,
        }
    return Check(
        f"0.{name.split(',')[0]}",
        f"Does lambda = 2 avoid the trap and reach the goal (annotators: {name})?",
        {"UARD": "avoids the trap and converges to the goal (L1108)"},
        table,
        verdict,
        False,
        ("J7", "J26", "J30", "A21", "A38"),
    )


def _row(method: str) -> paper.BaselineRow:
    return next(r for r in paper.TABLE_3 if r.method == method)


def hacker_policy(grid: TrapGrid, spread_ties: bool = True) -> np.ndarray:
    """Return (S, A) probabilities of the greedy policy of raw Q-learning's fixed point.

    Args:
        grid: The grid.
        spread_ties: Share equally between equally good actions; otherwise the first is taken.
    """
    q = _solved(grid)
    if not spread_ties:
        return np.eye(q.shape[1])[bellman.greedy_actions(q)]
    best = (q >= q.max(1, keepdims=True) - 1e-9).astype(float)
    return best / best.sum(1, keepdims=True)


def table_3() -> list[Check]:
    """Section a: the comparison of baselines on 10x10 (F3)."""
    rows, last = paper.TABLE_3, paper.LAST_EPISODES
    trap, step = paper.TRAP_REWARD, paper.STEP_REWARD
    visits = {r.method: r.visits.mean / last for r in rows}

    exclusive = {r.method: ((trap - step) * visits[r.method] - r.reward.mean) / -step for r in rows}
    inclusive = {r.method: (trap * visits[r.method] - r.reward.mean) / -step for r in rows}
    residual = {r.method: r.reward.mean - (4.1 * visits[r.method] - 10.0) for r in rows}
    from_sd = {r.method: 4.1 * r.visits.sd / last for r in rows}
    worst = max(abs(x) for x in residual.values())
    arrival = (paper.GOAL_REWARD - step) / (paper.SEEDS * last)
    checks = [
        Check(
            "a.horizon",
            "What horizon T do reward and visits imply, from R = 4 v - 0.1 (T - v)?",
            {"T (L901)": float(paper.HORIZON[10]), "T (L1002)": float(paper.HORIZON_IN_TEXT)},
            dict(exclusive),
            "T = 100 in all five rows, not 80 and not 40",
            False,
            ("F3", "B1", "B2", "E13"),
        ),
        Check(
            "a.horizon-inclusive",
            "And if entering a trap also cost the step's 0.1?",
            {},
            dict(inclusive),
            "the rows then contradict each other: a trap pays its reward instead of the step's",
            None,
            ("F3", "B5"),
        ),
        Check(
            "a.identity",
            "Is R = 4.1 v - 10 in every row?",
            {r.method: r.reward.mean for r in rows},
            {**residual, "largest residual": worst},
            "to the cent: every episode of every seed ran all 100 steps",
            None,
            ("F3",),
        ),
        Check(
            "a.sd",
            "Is SD(R) = 4.1 SD(v)?",
            {r.method: r.reward.sd for r in rows},
            dict(from_sd),
            "yes, to the rounding: reward is a function of visits alone",
            None,
            ("F3",),
        ),
        Check(
            "a.goal",
            "Did anybody reach the goal in the last 100 episodes?",
            {"UARD": "converges to the goal (L1108, L1143)"},
            {"shift of the mean by one arrival in 1000 episodes": arrival, "largest residual": worst},
            "nobody, UARD included: one arrival would show",
            False,
            ("J26", "J29", "J30", "F3"),
        ),
    ]
    return [*checks, *_table_3_chains(visits)]


def _table_3_chains(visits: dict[str, float]) -> list[Check]:
    last = paper.LAST_EPISODES
    ceilings = {(n, t): most_visits(paper_grid(n, horizon=t)) for n, t in paper.HORIZON.items()}
    ceilings[10, TABLE_3_HORIZON] = most_visits(paper_grid(10, horizon=TABLE_3_HORIZON))
    grid = paper_grid(10, horizon=TABLE_3_HORIZON)
    policy = hacker_policy(grid)
    episodes = np.arange(paper.EPISODES - last, paper.EPISODES)
    hacker = episode_outcome(grid, policy, paper.EPSILON[1] ** episodes)
    total, sd = float(hacker.visits.sum()), float(np.sqrt(hacker.visits_variance.sum()))
    other = episode_outcome(grid, hacker_policy(grid, spread_ties=False), paper.EPSILON[1] ** episodes)
    z = {m: (_row(m).visits.mean - total) / (sd / math.sqrt(paper.SEEDS)) for m in ("CQL", "TRPO", "CPO", "DQN")}
    constant = np.linspace(0.05, 0.2, 31)
    curve = episode_outcome(grid, policy, constant).visits
    implied = {m: float(np.interp(-visits[m], -curve, constant)) for m in ("DQN", "CPO")}
    random = episode_outcome(grid, policy, 1.0)
    walker = float(random.visits[0])
    reduction = 100.0 * (1.0 - walker / visits["DQN"])
    uard = _row("UARD")
    reductions = {m: 100.0 * (1.0 - v / visits["DQN"]) for m, v in visits.items()}
    return [
        Check(
            "a.ceiling",
            "How many trap visits are possible in one episode?",
            {m: v for m, v in visits.items() if m != "UARD"},
            {f"{n}x{n}, T = {t}": float(c) for (n, t), c in ceilings.items()},
            "the 42.9 to 43.7 of Table 3 are impossible at T = 80",
            False,
            ("F3", "B1"),
        ),
        Check(
            "a.hacker",
            "What would epsilon-greedy tabular Q-learning that has learned to hack do in episodes 401-500 (T = 100)?",
            {m: _row(m).visits.mean for m in z},
            {
                "visits in 100 episodes": total,
                "SD": sd,
                "visits, first of tied actions": float(other.visits.sum()),
                "mean reward": float(hacker.observed_return.mean()),
                **{f"z of {m}": value for m, value in z.items()},
            },
            "the CQL and TRPO rows cannot be told from it (|z| < 2), but TRPO has no epsilon; CPO and DQN hack less",
            None,
            ("F3", "D7", "D9", "J35"),
        ),
        Check(
            "a.epsilon",
            "Which constant epsilon would give the rows of DQN and CPO?",
            {"mean epsilon of the schedule, episodes 401-500": float(np.mean(paper.EPSILON[1] ** episodes))},
            dict(implied),
            "0.12, where the schedule leaves 0.11",
            None,
            ("F3", "E9"),
        ),
        Check(
            "a.random",
            "What does a uniformly random walker score (T = 100)?",
            {"visits": visits["UARD"], "reduction %": uard.reduction, "reward": uard.reward.mean, "goal %": 0.0},
            {
                "visits": walker,
                "reduction %": reduction,
                "reward": float(random.observed_return[0]),
                "goal %": 100.0 * float(random.goal_rate[0]),
            },
            "fewer visits than UARD, and it reaches the goal more often: visits alone measure nothing",
            False,
            ("J16", "J29", "A47", "F3"),
        ),
        Check(
            "a.cost-limit",
            "Does CPO keep its cost limit, if entering a trap costs 1?",
            {"limit": paper.CPO_COST_LIMIT},
            {"visits": visits["CPO"], "times the limit": visits["CPO"] / paper.CPO_COST_LIMIT},
            "86 times over: no cost was wired to the trap",
            False,
            ("D8", "J35"),
        ),
        Check(
            "a.percent",
            "Do the reductions follow from the visits?",
            {r.method: r.reduction for r in paper.TABLE_3},
            dict(reductions),
            "yes",
            all(round(reductions[r.method], 1) == r.reduction for r in paper.TABLE_3),
            ("J16", "F3"),
        ),
        Check(
            "a.optimum",
            "Is a reward of 1.23 'stable reward performance'?",
            {"UARD": uard.reward.mean},
            {"walking to the goal": _straight_return(10)},
            "the way to the goal pays 8.3",
            False,
            ("J29", "J30"),
        ),
    ]


def _straight_return(size: int) -> float:
    """Return of the shortest way to the goal that avoids the traps."""
    task = paper_grid(size, trap_reward=paper.STEP_REWARD * 1000).task()
    path = bellman.greedy_path(
        bellman.solve(task.reward, 1.0, task.next_state, task.terminal, paper.GAMMA),
        task,
    )
    return round(float(np.asarray(task.reward, float)[list(path.states[:-1]), list(path.actions)].sum()), 6)


def table_2() -> list[Check]:
    """Section a': the grid sizes (F2)."""
    by_size = {r.size: r for r in paper.TABLE_2}
    ceilings = {n: most_visits(paper_grid(n)) for n in SIZES}
    episodes = np.arange(paper.EPISODES - paper.LAST_EPISODES, paper.EPISODES)
    hackers = {
        n: float(episode_outcome(g, hacker_policy(g), paper.EPSILON[1] ** episodes).visits.sum())
        for n, g in ((n, paper_grid(n)) for n in SIZES)
    }
    reduction = {n: 100.0 * (1.0 - r.uard.mean / r.baseline.mean) for n, r in by_size.items()}
    dqn, uard = _row("DQN").visits.mean, _row("UARD").visits.mean
    ten = by_size[10]
    return [
        Check(
            "a2.units",
            "Are the hits per episode or per 100 episodes?",
            {f"{n} baseline": r.baseline.mean for n, r in by_size.items()},
            {f"{n} ceiling per episode": float(c) for n, c in ceilings.items()}
            | {f"{n} hacker per 100 episodes": v for n, v in hackers.items()}
            | {f"{n} baseline per episode, if per 100": by_size[n].baseline.mean / 100.0 for n in (8, 10)},
            "6x6 is per episode (L1149); 8x8 and 10x10 can only be per 100 episodes, and then almost nobody hacks: "
            "units are mixed, and the growth with the grid is an artefact",
            False,
            ("F2", "J28"),
        ),
        Check(
            "a2.same-grid",
            "Do Table 2 and Table 3 agree on 10x10, final 100 episodes?",
            {"baseline": ten.baseline.mean, "UARD": ten.uard.mean},
            {"baseline, Table 3 / Table 2": dqn / ten.baseline.mean, "UARD, Table 3 / Table 2": uard / ten.uard.mean},
            "they differ thirtyfold",
            False,
            ("F2", "F3", "J28"),
        ),
        Check(
            "a2.percent",
            "Do 87.4 % and 92.9 % follow?",
            {"8": paper.PERCENT["hits-8x8"].value, "10": paper.PERCENT["hits-10x10"].value},
            {str(n): reduction[n] for n in (8, 10)},
            "yes",
            all(round(reduction[n], 1) == paper.PERCENT[f"hits-{n}x{n}"].value for n in (8, 10)),
            ("J18", "F2"),
        ),
        Check(
            "a2.up-to",
            "Is 'up to 93.6 %' the largest reduction in the paper?",
            {"up to": paper.PERCENT["hacking"].value},
            {"6": reduction[6]},
            "no: the 6x6 row of Table 2 gives 100 %",
            False,
            ("J16", "F2"),
        ),
    ]


def table_4() -> list[Check]:
    """Section b: returns and gaps on 6x6 (F4)."""
    base, multi, uard = paper.TABLE_4
    horizon, step = paper.HORIZON[6], paper.STEP_REWARD
    assert uard.gap is not None
    gap = abs(uard.observed_return.mean - uard.true_return.mean)
    base_gap = abs(base.observed_return.mean - base.true_return.mean)
    straight = _straight_return(6)
    checks = [
        Check(
            "b.path",
            "Which behaviour gives an observed return of 9.1, and which a true return of -4.0?",
            {"observed": uard.observed_return.mean, "true": uard.true_return.mean},
            {"shortest way to the goal": straight, "never arriving in 40 steps": round(step * horizon, 6)},
            "the first needs the goal every time, the second never: the row mixes two agents",
            False,
            ("F4", "J30"),
        ),
        Check(
            "b.gap",
            "Can the mean gap be 3.2? (E|x| >= |E x|)",
            {"gap": uard.gap.mean},
            {"least possible": gap},
            "no: at least 13.1",
            False,
            ("F4", "J19"),
        ),
        Check(
            "b.percent",
            "Is the gap reduced by 95.9 %?",
            {"reduction %": paper.PERCENT["gap"].value, "gap before": paper.TEXT["baseline gap"].value},
            {
                "from the printed gap": 100.0 * (1.0 - uard.gap.mean / base_gap),
                "from the printed returns": 100.0 * (1.0 - gap / base_gap),
                "gap before": base_gap,
            },
            "83.1 % from the table's own returns",
            False,
            ("J19",),
        ),
    ]
    return [*checks, *_trap_worth(base, multi, uard)]


def _trap_worth(base: paper.PerformanceRow, multi: paper.PerformanceRow, uard: paper.PerformanceRow) -> list[Check]:
    horizon, step, trap = paper.HORIZON[6], paper.STEP_REWARD, paper.TRAP_REWARD
    ceiling = most_visits(paper_grid(6))
    figure = paper.FIGURES["G8"].numbers
    lowest = {base.agent: _range(figure["baseline"])[0], multi.agent: _number(figure["multi-head lowest"])}
    worth: Values = {}
    level: Values = {}
    for r in (base, multi):
        v = r.visits.mean
        worth[f"{r.agent}, means"] = (r.true_return.mean - step * (horizon - v)) / v
        worth[f"{r.agent}, gap per visit"] = trap - (r.observed_return.mean - r.true_return.mean) / v
        worth[f"{r.agent}, lowest of the curve, at most"] = (lowest[r.agent] - step * (horizon - ceiling)) / ceiling
        worth[f"{r.agent}, |worth + 0.1| from SDs"] = r.true_return.sd / r.visits.sd
        level[f"{r.agent} observed"] = (trap - step) * v + step * horizon
        level[f"{r.agent} true, trap worth -1"] = (-1.0 - step) * v + step * horizon
    sd_ratio = (multi.true_return.sd / base.true_return.sd) ** 2
    worst = -lowest[base.agent]
    return [
        Check(
            "b.trap-worth",
            "What is a trap truly worth? (The paper never says.)",
            {},
            worth,
            "no single number fits; -1 comes nearest to the baseline's means and to sigma_h = 1.247",
            None,
            ("B7", "F4", "G8"),
        ),
        Check(
            "b.levels",
            "Do the returns follow from the visits?",
            {"Baseline observed": base.observed_return.mean, "Multi-Head observed": multi.observed_return.mean},
            level,
            "both rows lack as much in the observed as in the true return: an undisclosed cost, or other runs",
            False,
            ("F4",),
        ),
        Check(
            "b.multi-head",
            "Does the multi-head ablation 'improve stability marginally'?",
            {"SD baseline": base.true_return.sd, "SD multi-head": multi.true_return.sd},
            {"variance ratio": sd_ratio, "p": float(stats.f.sf(sd_ratio, paper.SEEDS - 1, paper.SEEDS - 1))},
            "its SD is 2.3 times the baseline's, and its true return is worse with fewer visits",
            False,
            ("F4", "G8"),
        ),
        Check(
            "b.stability",
            "What is the 91.7 % improvement in policy stability?",
            {"improvement %": paper.PERCENT["stability"].value},
            {
                "1 - 4.0 / 48.6": 100.0 * (1.0 - uard.true_return.mean / -worst),
                "by SDs": 100.0 * (1.0 - uard.true_return.sd / base.true_return.sd),
            },
            "a final level over another agent's worst point (91.77, cut off): not a measure of stability",
            False,
            ("J20", "A50"),
        ),
        Check(
            "b.zero-one",
            "Can visits be 0 +- 1?",
            {"mean": uard.visits.mean, "SD": uard.visits.sd},
            {"SD of counts with mean 0": 0.0, "largest SD of ten with mean 0.5": 0.5 * math.sqrt(paper.SEEDS)},
            "only if the 0 is a rounded number up to 0.5, all of it from one or two seeds",
            None,
            ("F2", "F4", "F5"),
        ),
        Check(
            "b.ranges",
            "Do the two ranges given for the baseline's true return agree?",
            {"L1171": _interval(paper.FIGURES["G5"].numbers["baseline true"]), "L1945": _interval(figure["baseline"])},
            {"never arriving, no trap": step * horizon},
            "no; and with an upper end of -4.0 it never 'occasionally reaches the goal' (L1945) on average",
            False,
            ("G5", "G8", "J20"),
        ),
    ]


def _interval(value: paper.Number | Stat) -> str:
    low, high = _range(value)
    return f"{low:g} to {high:g}"


def _number(value: paper.Number | Stat) -> float:
    if isinstance(value, tuple):
        raise TypeError("a single number is wanted here")
    return float(value)


def _range(value: paper.Number | Stat) -> tuple[float, float]:
    if not isinstance(value, tuple):
        raise TypeError("a range is wanted here")
    return value[0], value[1]


def t_test(first: Stat, second: Stat, welch: bool = False, n: int = paper.SEEDS) -> tuple[float, float]:
    """Return (t, two-sided p) of a two-sample t-test from printed means and SDs."""
    result = stats.ttest_ind_from_stats(first.mean, first.sd, n, second.mean, second.sd, n, equal_var=not welch)
    return float(result[0]), float(result[1])


def significance() -> list[Check]:
    """Section c: the statistical tests (I1-I3) and those that were not made."""
    n = paper.SEEDS
    base, _, uard = paper.TABLE_4
    t, p = t_test(base.visits, uard.visits)
    difference = base.visits.mean - uard.visits.mean
    printed = paper.TESTS["I1"].t or math.nan
    pooled = math.hypot(base.visits.sd, uard.visits.sd)
    welch, welch_p = t_test(uard.true_return, base.true_return, welch=True)
    ratio = (base.true_return.sd / uard.true_return.sd) ** 2
    dqn = _row("DQN").visits
    others = {r.method: t_test(r.visits, dqn, welch=True) for r in paper.TABLE_3 if r.method not in ("DQN", "UARD")}
    against = {r.method: min(1.0, 4 * t_test(r.visits, _row("UARD").visits, welch=True)[1]) for r in paper.TABLE_3[:-1]}
    ablation = {r.variant: t_test(paper.TABLE_5[0].visits, r.visits, welch=True)[1] for r in paper.TABLE_5[1:]}
    return [
        Check(
            "c.visits",
            "Is t = 29.15 for 16.2 +- 2.1 against 0 +- 1, n = 10?",
            {"t": printed},
            {
                "t": t,
                "p": p,
                "t, SDs with 1/n": t * math.sqrt((n - 1) / n),
                "largest t, other SD 0": difference / (base.visits.sd / math.sqrt(n)),
                "and with rounding in its favour": (difference + 0.05) / ((base.visits.sd - 0.05) / math.sqrt(n)),
                "n that gives 29.15": (printed * pooled / difference) ** 2,
                "difference that gives 29.15": printed * pooled / math.sqrt(n),
            },
            "22.0; not even an SD of 0 gives 29.15. The difference is significant all the same",
            False,
            ("I1",),
        ),
        Check(
            "c.true-return",
            "Does the true return differ with p < 0.01?",
            {"p below": paper.TESTS["I2"].p_below},
            {
                "Welch t": welch,
                "Welch p": welch_p,
                "variance ratio": ratio,
                "variance p": 2.0 * float(stats.f.sf(ratio, n - 1, n - 1)),
            },
            "yes, means and variances",
            welch_p < 0.01,
            ("I2",),
        ),
        Check(
            "c.baselines",
            "Does UARD differ from each baseline with p < 0.001 (Bonferroni), Table 3?",
            {"p below": paper.TESTS["I3"].p_below},
            dict(against),
            "yes",
            max(against.values()) < 0.001,
            ("I3", "F3"),
        ),
        Check(
            "c.worse-than-dqn",
            "Are CQL, TRPO and CPO 'slightly worse' than DQN?",
            {},
            {f"t {m}": x[0] for m, x in others.items()} | {f"p {m}": x[1] for m, x in others.items()},
            "CQL and TRPO hack significantly more than DQN, CPO does not differ",
            None,
            ("F3",),
        ),
        Check(
            "c.ablation",
            "Do the ablations without discounting differ from the baseline (Table 5)?",
            {"hierarchy": "clear (L1257)"},
            {f"p {variant}": value for variant, value in ablation.items()},
            "Ablation I does not (and is 14.5 +- 3.5 in Table 4); II does at 5 %, not after correction",
            False,
            ("J31", "F5"),
        ),
    ]


def _triples_with_sd(target: float, step: float, ddof: int) -> int:
    """Count unordered triples on a grid in [-10, 10] whose SD rounds to ``target`` at three decimals."""
    points = round(20 / step)
    gaps = np.arange(points + 1) * step
    first, second = np.meshgrid(gaps, gaps, indexing="ij")
    inside = first + second <= 20 + 1e-9
    sd = np.std(np.stack([np.zeros_like(first), first, first + second]), axis=0, ddof=ddof)
    hits = inside & (np.abs(np.round(sd, 3) - target) < 1e-9)
    return int((points + 1 - np.round((first + second)[hits] / step)).sum())


def annotators() -> list[Check]:
    """Section d: sigma_h = 1.247 and the annotators of the appendix."""
    target = paper.SIGMA_H_AT_TRAP
    trap = {d: RaterSpread(paper.APPENDIX_RATER_SD["trap"], d) for d in (0, 1)}
    elsewhere = {d: RaterSpread(paper.APPENDIX_RATER_SD["elsewhere"], d) for d in (0, 1)}
    needed = {
        d: bisect(lambda s, d=d: RaterSpread((*paper.APPENDIX_RATER_SD["trap"][:2], s), d).mean() - target, 0.5, 9.0)
        for d in (0, 1)
    }
    return [
        Check(
            "d.triples",
            "Which three ratings have an SD of 1.247?",
            {"sigma_h": target},
            {
                "integer triples in [-10, 10], population SD": _triples_with_sd(target, 1.0, 0),
                "integer triples, sample SD": _triples_with_sd(target, 1.0, 1),
                "halves, sample SD": _triples_with_sd(target, 0.5, 1),
                "tenths, sample SD": _triples_with_sd(target, 0.1, 1),
                "{-1, 2, 1}, population SD": float(np.std((-1, 2, 1))),
                "{-1, 2, 1}, sample SD": float(np.std((-1, 2, 1), ddof=1)),
            },
            "constants such as {-1, 2, 1} with 1/M: not the 1/(M-1) of the equation, and nothing stochastic",
            False,
            ("A14", "C1", "C3", "C8"),
        ),
        Check(
            "d.appendix",
            "Do the appendix's annotators give 1.247 at the trap?",
            {"sigma_h": target},
            {f"mean at traps, ddof {d}": s.mean() for d, s in trap.items()}
            | {f"mean elsewhere, ddof {d}": s.mean() for d, s in elsewhere.items()}
            | {f"P(at least 1.247), ddof {d}": s.exceeds(target) for d, s in trap.items()}
            | {f"third rater's SD for a mean of 1.247, ddof {d}": x for d, x in needed.items()},
            "no: a third of it on average; the two descriptions are of different people",
            False,
            ("C4", "C5", "C6", "C8", "J33"),
        ),
        Check(
            "d.frozen",
            "If ratings are drawn once, how often has a trap the smaller sigma_h of two cells?",
            {},
            {"P": trap[0].below(elsewhere[0])},
            "one time in six: store a running mean",
            None,
            ("C7", "C6"),
        ),
    ]


HAZARDS = (-1.25, -1.5, -2.0, -3.0, -5.0)
HAZARD_LAMBDAS = (0.0, 2.0, 5.0, 10.0)


def hazard_task(hazard: float) -> tuple[Task, np.ndarray]:
    """Return a small task and its contested steps: a hazard on the direct way, a detour of two steps more round it."""
    step, goal = paper.STEP_REWARD, paper.GOAL_REWARD
    entered = np.array([[1, 2], [5, 5], [3, 3], [4, 4], [5, 5], [5, 5]])
    reward = np.array([[hazard, step], [goal, goal], [step, step], [step, step], [goal, goal], [0.0, 0.0]])
    contested = np.zeros(entered.shape, bool)
    contested[0, 0] = True
    return Task(entered, reward, (entered == 5), 0, 10), contested


def _enters(hazard: float, lam: float, sign_aware: bool = False, anchored: bool = False) -> bool:
    task, contested = hazard_task(hazard)
    sigma = np.where(contested, paper.SIGMA_H_AT_TRAP, 0.0)
    weight = reciprocal_weight(paper.BETA * sigma, lam)
    if sign_aware:
        weight = np.where(task.reward < 0, 1.0 / weight, weight)
    anchor = task.reward - sigma if anchored else 0.0
    q = bellman.solve(task.reward, weight, task.next_state, task.terminal, paper.GAMMA, anchor)
    return bellman.greedy_path(q, task, contested).total_visits > 0


def negative_values() -> list[Check]:
    """Section e: below zero the filter prefers what it should avoid."""
    score = {"mu -1, U 0.1": -1.0 * reciprocal_weight(0.1), "mu -1.5, U 1.5": -1.5 * reciprocal_weight(1.5)}
    rng = np.random.default_rng(0)
    u, size = rng.uniform(0.0, 1.5, (20_000, 4)), rng.uniform(1.0, 2.0, (20_000, 4))
    chosen = {
        name: float(np.take_along_axis(u, (sign * size * reciprocal_weight(u)).argmax(1)[:, None], 1).mean())
        for name, sign in (("negative", -1.0), ("positive", 1.0))
    }
    entered: Values = {}
    for hazard in HAZARDS:
        lams = [lam for lam in HAZARD_LAMBDAS if _enters(hazard, lam)]
        entered[f"hazard {hazard:g} entered from lambda"] = lams[0] if lams else None
    repaired = sum(_enters(h, lam, sign_aware=True) for h in HAZARDS for lam in HAZARD_LAMBDAS)
    anchored = sum(_enters(h, lam, anchored=True) for h in HAZARDS for lam in HAZARD_LAMBDAS)
    kappa = {f"U {x}": 1.0 / (1.0 + x * x / (2.0 * -0.5)) for x in (0.3, 0.9, 1.0001, 1.1)}
    mu, doubt = np.array([10.0, 6.0]), np.array([0.5, 0.05])
    cases = {"as is": (mu, doubt), "all x 0.1": (0.1 * mu, 0.1 * doubt), "rewards - 10": (mu - 10.0, doubt)}
    scores = {name: m * reciprocal_weight(d) for name, (m, d) in cases.items()}
    return [
        Check(
            "e.order",
            "Is more uncertainty penalised 'regardless of the magnitude of mu'?",
            {"J": "consistently penalises actions with higher uncertainty"},
            {**score, "dJ / d sigma_m at mu = -1, U = 0": paper.LAMBDA * paper.ALPHA}
            | {f"mean U chosen, {name} values (indifference: 0.75)": value for name, value in chosen.items()},
            "only for mu > 0; for mu < 0 the worse and more uncertain action wins",
            False,
            ("J2", "J3", "A19"),
        ),
        Check(
            "e.penalty",
            "What is left of a true -1 on which the raters disagree by 1.247?",
            {},
            {
                f"lambda {lam:g}": -1.0 * reciprocal_weight(paper.BETA * paper.SIGMA_H_AT_TRAP, lam)
                for lam in (2.0, 10.0)
            },
            "less than half of the deterrent at lambda = 2, a seventh at 10",
            None,
            ("A21", "J7"),
        ),
        Check(
            "e.hazard",
            "Is a hazard on the direct way avoided, given a detour of two steps more?",
            {"UARD": "steers away from unreliable regions (L2182)"},
            {
                **entered,
                "cells entered with sign-aware weights": repaired,
                "cells entered with an anchor one sigma_h below the reward": anchored,
            },
            "hazards that lambda = 0 avoids are entered at 2, 5 or 10: more lambda is less safe",
            False,
            ("J3", "J7", "A21", "J34"),
        ),
        Check(
            "e.kappa",
            "Does the certainty-equivalent weight lie in (0, 1] (mu = -0.5, kappa = 1)?",
            {"w": "(0, 1]"},
            dict(kappa),
            "not for mu < 0",
            False,
            ("A25", "A28", "J11"),
        ),
        Check(
            "e.scale",
            "Does the choice survive a change of the reward's unit or zero (mu = (10, 6), U = (0.5, 0.05))?",
            {},
            {f"{name}: J of the two": ", ".join(f"{x:.3f}" for x in s) for name, s in scores.items()}
            | {f"{name}: chosen": float(s.argmax()) for name, s in scores.items()},
            "no: both change it, so one lambda for grids and MuJoCo means nothing",
            False,
            ("E3", "J9"),
        ),
    ]


def critical_ratio(size: int, trap_reward: float) -> float:
    """Return the largest w(trap) / w(elsewhere) at which T_lambda's fixed point goes to the goal."""
    grid = paper_grid(size, trap_reward)
    sigma = _at_traps(grid, 2.0)
    lam = bellman.critical_lambda(grid.task(), grid.truth().hack, sigma, gamma=paper.GAMMA, beta=0.5)
    assert lam is not None
    return 1.0 / (1.0 + lam)


def critical_lambdas(
    trap: float,
    elsewhere: float,
    trap_reward: float,
    form: Form = "reciprocal",
    anchor: float = 0.0,
    visits_allowed: int | None = None,
) -> dict[int, float | None]:
    """Return the smallest lambda at which T_lambda's fixed point goes to the goal, by grid size.

    Args:
        trap: sigma_h at traps.
        elsewhere: sigma_h of all other steps.
        trap_reward: What a trap pays.
        form: Of the filter.
        anchor: The pessimistic reward b.
        visits_allowed: Traps that may be crossed on the way; any number if left out.
    """
    grids = {size: paper_grid(size, trap_reward) for size in SIZES}
    return {
        size: bellman.critical_lambda(
            grid.task(),
            grid.truth().hack,
            _at_traps(grid, trap, elsewhere),
            gamma=paper.GAMMA,
            beta=paper.BETA,
            form=form,
            anchor=anchor,
            visits_allowed=visits_allowed,
        )
        for size, grid in grids.items()
    }


def _numbers(values: Values) -> list[float]:
    return [value for value in values.values() if isinstance(value, int | float)]


def _named(name: str, values: dict[int, float | None]) -> Values:
    return {f"{name}, {size}": value for size, value in values.items()}


def _fresh_lambda(
    ratio: float, trap: Callable[[float], float], elsewhere: Callable[[float], float], high: float = 1e4
) -> float | None:
    """Return the lambda at which mean weights reach a ratio, or None up to ``high``."""

    def excess(lam: float) -> float:
        return trap(lam) / elsewhere(lam) - ratio

    return None if excess(high) > 0 else bisect(excess, 0.0, high, rounds=45)


def operator() -> list[Check]:
    """Section f: the fixed point of T_lambda (A21-A23), the operator of Theorem 1."""
    rewards = (paper.TRAP_REWARD, paper.HARD_TRAP_REWARD)
    sigmas = annotator_sigmas()
    at_two: Values = {}
    hacking = 0
    for name, (trap, elsewhere) in sigmas.items():
        for reward in rewards:
            for size in SIZES:
                grid = paper_grid(size, reward)
                weight = reciprocal_weight(paper.BETA * _at_traps(grid, trap, elsewhere), paper.LAMBDA)
                path, text = _walk(grid, _solved(grid, weight))
                hacking += not path.reached_goal
                at_two[f"{name}, +{reward:g}, {size}"] = text
    table: Values = {}
    for name, (trap, elsewhere) in sigmas.items():
        for reward in rewards:
            table |= _named(f"{name}, +{reward:g}", critical_lambdas(trap, elsewhere, reward))
    at_five = sum(value <= paper.TEXT["lambda avoids"].value for value in _numbers(table))
    table["settings that arrive at lambda = 5"] = float(at_five)
    trap = sigmas["main, population SD"][0]
    for reward in rewards:
        table |= _named(f"exponential, main, +{reward:g}", critical_lambdas(trap, 0.0, reward, "exponential"))
    ratios = {(size, reward): critical_ratio(size, reward) for reward in rewards for size in SIZES}
    return [
        Check(
            "f.lambda-2",
            "Does the greedy policy of T_lambda's fixed point stop hacking at lambda = 2?",
            {"UARD": "prevents over-optimisation (L508)"},
            {**at_two, "settings that hack": float(hacking), "settings": float(len(at_two))},
            f"it hacks in {hacking} of {len(at_two)} settings",
            hacking == 0,
            ("J7", "A21", "A23"),
        ),
        Check(
            "f.critical-lambda",
            "At which lambda does the fixed point go to the goal?",
            {
                "lambda": paper.LAMBDA,
                "avoids": paper.TEXT["lambda avoids"].value,
                "too large": paper.TEXT["lambda too large"].value,
            },
            table,
            "4 to 18 with the main annotators, so 5 is enough in two settings of 24; at none with the appendix's, "
            "because the goal is discounted too",
            False,
            ("J34", "E3", "A21"),
        ),
        Check(
            "f.critical-ratio",
            "How small must w(trap) / w(elsewhere) be?",
            {},
            {f"+{reward:g}, {size}": ratio for (size, reward), ratio in ratios.items()}
            | _appendix_limits()
            | {"main at lambda = 2": reciprocal_weight(paper.BETA * trap, paper.LAMBDA)},
            "the appendix's annotators stay above it however large lambda is",
            None,
            ("A21", "C6"),
        ),
        _fresh_ratings(ratios),
        *_positivity(),
        *_theorem(),
        *_other_rewards(),
        _noisy_ratings(ratios),
    ]


def _appendix_limits() -> Values:
    trap, elsewhere = (RaterSpread(sd, 0) for sd in paper.APPENDIX_RATER_SD.values())
    return {
        "appendix, lambda to infinity, w of the mean sigma_h": elsewhere.mean() / trap.mean(),
        "appendix, lambda to infinity, mean w of fresh draws": float(
            np.mean(1.0 / np.sqrt(trap.g)) / np.mean(1.0 / np.sqrt(elsewhere.g))
        ),
    }


def _fresh_ratings(ratios: dict[tuple[int, float], float]) -> Check:
    """Who disagrees where, with the weight of the mean sigma_h or the mean weight of fresh ratings at every visit."""
    trap, elsewhere = (RaterSpread(sd, 0) for sd in paper.APPENDIX_RATER_SD.values())

    def constant(sigma: float) -> Callable[[float], float]:
        return lambda lam: reciprocal_weight(paper.BETA * sigma, lam)

    main, agree = constant(paper.SIGMA_H_AT_TRAP), constant(0.0)
    cases = {
        "main at traps, appendix elsewhere; mean sigma_h": (main, constant(elsewhere.mean())),
        "main at traps, appendix elsewhere; fresh": (main, elsewhere.mean_weight),
        "appendix at traps, agreement elsewhere; mean sigma_h": (constant(trap.mean()), agree),
        "appendix at traps, agreement elsewhere; fresh": (trap.mean_weight, agree),
        "appendix; fresh": (trap.mean_weight, elsewhere.mean_weight),
    }
    table: Values = {
        f"{name}, +{reward:g}, {size}": _fresh_lambda(ratio, *pair)
        for name, pair in cases.items()
        for (size, reward), ratio in ratios.items()
    }
    return Check(
        "f.fresh-ratings",
        "And if raters disagree only here or only there, or rate afresh at every visit, so that mean weights count?",
        {"lambda": paper.LAMBDA},
        {**table, "mean w at traps, appendix, lambda = 2": trap.mean_weight(paper.LAMBDA)},
        "far above 2 everywhere, and none for the appendix",
        False,
        ("J34", "C7", "A21"),
    )


def _positivity() -> list[Check]:
    crossings: Values = {}
    for size in SIZES:
        grid = paper_grid(size)
        crossings[str(size)] = _walk(grid, _solved(grid, _at_traps(grid, 1e-3, 1.0)))[1]
    rewards = (paper.TRAP_REWARD, paper.HARD_TRAP_REWARD)
    largest = {reward: -paper.STEP_REWARD / reward for reward in rewards}
    base = paper.TABLE_4[0].visits.mean
    return [
        Check(
            "f.positivity",
            "Can w > 0 on a positive reward give zero visits? (w = 0.001 at traps)",
            {"visits": 0.0},
            crossings,
            "no: crossing a trap still pays more than a step, at any lambda",
            False,
            ("J17", "A25", "F4"),
        ),
        Check(
            "f.93.7",
            "Where can 93.7 % come from, and is it the 93.6 % of the abstract?",
            {"6x6": paper.PERCENT["visits-6x6"].value, "abstract": paper.PERCENT["hacking"].value},
            {
                "Table 3, 10x10": 100.0 * (1.0 - _row("UARD").visits.mean / _row("DQN").visits.mean),
                "one crossing in 16": 100.0 * (1.0 - 1.0 / _number(paper.FIGURES["G4"].numbers["baseline up to"])),
                "one in 16.2": 100.0 * (1.0 - 1.0 / base),
            },
            "one visit (or the SD of 1) over 16, per episode on 6x6; 93.6 % is another experiment in another unit",
            None,
            ("J16", "J17"),
        ),
        Check(
            "f.undiscounted",
            "Without discounting and with a horizon, when does another bounce before the goal stop paying?",
            {"lambda": paper.LAMBDA},
            {f"w, +{reward:g}": w for reward, w in largest.items()}
            | {
                f"lambda, +{reward:g}": (1.0 / w - 1.0) / (paper.BETA * paper.SIGMA_H_AT_TRAP)
                for reward, w in largest.items()
            }
            | {
                f"visits of the best policy of 40 steps, 6x6, +4, w = {w}": float(_visits_within_horizon(6, w))
                for w in (0.024, 0.026)
            },
            "when w times the trap's reward is below a step's cost of 0.1",
            None,
            ("J34", "A21"),
        ),
    ]


def _visits_within_horizon(size: int, weight: float) -> int:
    """Visits of the policy that maximises the undiscounted weighted return within the horizon."""
    grid = paper_grid(size)
    task, hack = grid.task(), grid.truth().hack
    reward = np.where(hack, weight, 1.0) * np.asarray(task.reward, float)
    value, policies = np.zeros(len(reward)), []
    for _ in range(int(task.horizon)):
        q = reward + np.where(task.terminal, 0.0, value[task.next_state])
        policies.append(bellman.greedy_actions(q))
        value = q.max(1)
    state, visits = int(task.start), 0
    for policy in reversed(policies):
        action = policy[state]
        visits += int(hack[state, action])
        if task.terminal[state, action]:
            break
        state = int(task.next_state[state, action])
    return visits


def _theorem() -> list[Check]:
    grid = paper_grid(6)
    task, hack = grid.task(), grid.truth().hack
    reward = np.asarray(task.reward, float)
    place = tuple(int(i) for i in np.argwhere(hack)[0])
    weight = reciprocal_weight(paper.BETA * _at_traps(grid, paper.SIGMA_H_AT_TRAP), paper.LAMBDA)
    frozen = bellman.contraction_ratio(reward, weight, task.next_state, task.terminal, paper.GAMMA, pairs=500)
    live = {
        f"+{r:g}": bellman.live_weight_expansion(
            np.where(hack, r, reward), task.next_state, task.terminal, paper.GAMMA, gap=1e-4, place=(place[0], place[1])
        ).ratio
        for r in (4.0, 10.0)
    }
    anywhere = bellman.live_weight_expansion(reward, task.next_state, task.terminal, paper.GAMMA, gap=1e-4)
    heads = np.random.default_rng(0).normal(0.0, 3.0, (*reward.shape, paper.HEADS))
    start = float(np.ptp(heads, axis=-1).max())
    for _ in range(600):
        heads = bellman.ensemble_backup(heads, reward, task.next_state, task.terminal, paper.GAMMA)
    raw = _solved(grid)
    lite, _ = _walk(grid, heads.mean(-1))
    human, _ = _walk(grid, raw * weight)
    return [
        Check(
            "f.contraction",
            "Is T_lambda a 0.95-contraction with frozen weights (500 random pairs)?",
            {"gamma": paper.GAMMA},
            {"largest ratio": frozen},
            "yes",
            frozen <= paper.GAMMA + 1e-9,
            ("J5", "J6"),
        ),
        Check(
            "f.live",
            "And with the weights that are actually used, w(sigma_m(Q)) of five heads?",
            {"gamma": paper.GAMMA},
            {f"trap {name}": ratio for name, ratio in live.items()}
            | {"worst place of the 6x6 grid (entering the goal)": anywhere.ratio},
            "it expands more than fivefold: the theorem does not cover it",
            False,
            ("J5", "J6"),
        ),
        Check(
            "f.sigma-m",
            "What is left of sigma_m at the fixed point (UARD-lite: no sigma_h)?",
            {"UARD-lite visits": paper.TABLE_5[3].visits.mean, "human-only visits": paper.TABLE_5[4].visits.mean},
            {
                "largest gap between heads at first": start,
                "after 600 sweeps": float(np.ptp(heads, axis=-1).max()),
                "distance from raw Q": float(np.abs(heads.mean(-1) - raw).max()),
                "UARD-lite visits": float(lite.total_visits),
                "human-only visits, acting on J": float(human.total_visits),
            },
            "nothing: UARD-lite becomes raw Q-learning, so Table 5's order of lite and human-only is backwards",
            False,
            ("J32", "J33", "J26", "F5"),
        ),
    ]


def _other_rewards() -> list[Check]:
    means = {"main {-1, 2, 1}": float(np.mean((-1, 2, 1))), "appendix": -1.0}
    plain: Values = {}
    for name, mean in means.items():
        for size in SIZES:
            grid = paper_grid(size)
            rated = np.where(grid.truth().hack, mean, grid.task().reward)
            plain[f"{name}, {size}"] = _walk(grid, _solved(grid, reward=rated))[1]
    sigma = paper.SIGMA_H_AT_TRAP
    floor: Values = {}
    for reward in (paper.TRAP_REWARD, paper.HARD_TRAP_REWARD):
        floor |= _named(f"goal, +{reward:g}", critical_lambdas(sigma, 0.0, reward, anchor=-1.0))
        zero = critical_lambdas(sigma, 0.0, reward, anchor=-1.0, visits_allowed=0)
        floor |= _named(f"goal without a visit, +{reward:g}", zero)
    return [
        Check(
            "f.mean-rating",
            "What does an agent do that learns from the mean rating, without any filter?",
            {},
            plain,
            "with the appendix's truthful raters it avoids the trap and arrives; with the main ones it hacks on 10x10",
            None,
            ("A13", "C4", "J15"),
        ),
        Check(
            "f.anchor",
            "At which lambda does the anchored filter (b = -1, main annotators) arrive?",
            {},
            floor,
            "half of the unanchored lambda, and without a visit from 7.3 (+4) or 14.4 (+8)",
            None,
            ("A21",),
        ),
    ]


def _noisy_ratings(ratios: dict[tuple[int, float], float]) -> Check:
    """Noise on every rater of {-1, 2, 1} (0 elsewhere): sigma_h is then a Rice variable over the root of 3."""
    away, root = math.sqrt(3.0) * float(np.std((-1, 2, 1))), math.sqrt(3.0)
    ratio = ratios[6, paper.TRAP_REWARD]
    table: Values = {}
    for noise in (0.0, 0.3, 1.2):
        if noise:
            trap = stats.rice.ppf(_V**2, away / noise, scale=noise) / root
            elsewhere = noise * _RAYLEIGH / root
        else:
            trap, elsewhere = np.full_like(_V, away / root), np.zeros_like(_V)

        def fresh(lam: float, sigma: np.ndarray) -> float:
            return float(reciprocal_weight(paper.BETA * sigma, lam) @ _MASS)

        def frozen(lam: float, sigma: np.ndarray) -> float:
            return reciprocal_weight(paper.BETA * float(sigma @ _MASS), lam)

        for name, weight in (("mean sigma_h", frozen), ("fresh ratings", fresh)):
            on, off = partial(weight, sigma=trap), partial(weight, sigma=elsewhere)
            table[f"noise {noise}, {name}: w ratio at lambda = 2"] = on(2.0) / off(2.0)
            table[f"noise {noise}, {name}: lambda that arrives"] = _fresh_lambda(ratio, on, off)
    return Check(
        "f.noise",
        "Is the filter invariant to noise on every rater (main annotators, 6x6, +4)?",
        {"noise": "invariant (L2040)"},
        table,
        "the reverse: noise makes trap and path look alike, and at SD 1.2 no lambda is enough",
        False,
        ("J25", "A21"),
    )


def sign_preservation() -> list[Check]:
    """Section g: who preserves the sign of an advantage longer, UARD or PPO?"""
    w = reciprocal_weight(paper.BETA * paper.SIGMA_H_AT_TRAP, paper.LAMBDA)
    radius = {
        "raw rewards perturbed, common w": sign_preservation_radius(1.0, w, "before"),
        "filtered advantage perturbed": sign_preservation_radius(1.0, w, "after"),
        "the uncertain rival inflated": sign_preservation_radius(1.0, w, "towards-uncertain"),
    }
    larger = {name: "equal" if abs(r - 1) < 1e-9 else "UARD" if r > 1 else "PPO" for name, r in radius.items()}
    return [
        Check(
            "g.radius",
            "Whose sign-preservation radius is larger (UARD's in units of PPO's)?",
            {"L2078": "UARD", "L2084": "PPO"},
            {**radius, **{f"larger when {name}": who for name, who in larger.items()}},
            "the two sentences contradict each other; each is true of another definition",
            False,
            ("J40", "J41", "A45"),
        )
    ]


def _largest_equal(stat: Stat, count: int, n: int = paper.SEEDS) -> float:
    """The largest value that ``count`` of n numbers can all reach, given their mean and sample SD."""
    return stat.mean + stat.sd * math.sqrt((n - 1) * (n - count) / (n * count))


def consistency() -> list[Check]:
    """Section h: counts, percentages and settings that contradict each other."""
    g11 = paper.FIGURES["G11"].numbers
    low, high, uard = (Stat(*_range(g11[k])) for k in ("baseline at 0", "baseline at 30", "UARD at 30"))
    limit = paper.TEXT["seed exceeds"].value
    rounded_up = Stat(high.mean + 0.05, high.sd + 0.05)
    can = [k for k in range(1, paper.SEEDS) if _largest_equal(rounded_up, k) > limit]
    quiet = t_test(low, Stat(*_range(g11["UARD at 0"])), welch=True)
    ratio = (high.sd / low.sd) ** 2
    crossing = bisect(lambda x: x - 2.0 * math.log1p(x), 1.0, 10.0)
    x = paper.SIGMA_H_AT_TRAP
    _, factor, floor = paper.EPSILON
    off = [n for n in SIZES if max(paper.GOAL_IN_APPENDIX) >= n]
    hours = paper.TEXT["GPU hours"].value
    tabled = [name for name, where in paper.BASELINES.items() if "F3" in where]
    nowhere = [name for name, where in paper.BASELINES.items() if not where]
    return [
        Check(
            "h.percent",
            "Do 277 % and 98.3 % follow?",
            {"rise %": paper.PERCENT["noise-rise"].value, "lower %": paper.PERCENT["noise-lower"].value},
            {"rise %": 100.0 * (high.mean / low.mean - 1.0), "lower %": 100.0 * (1.0 - uard.mean / high.mean)},
            "yes; but the baselines do not read the ratings (L1088), so noise on them should change nothing",
            True,
            ("J21", "J25", "G11"),
        ),
        Check(
            "h.exceeds",
            "Can several seeds exceed 40 with a mean of 23.4 +- 8.3 of ten?",
            {"exceeds": limit},
            {f"largest value that {k} can all reach": _largest_equal(high, k) for k in (1, 2)}
            | {"seeds that can, rounding in their favour": float(max(can, default=0))},
            "one at most, and the text has several",
            False,
            ("J45", "G11"),
        ),
        Check(
            "h.variance",
            "Does the baselines' variance 'increase substantially with noise'?",
            {"SD at 0 %": low.sd, "SD at 30 %": high.sd},
            {
                "variance ratio": ratio,
                "p": float(stats.f.sf(ratio, paper.SEEDS - 1, paper.SEEDS - 1)),
                "SD / mean at 0 %": low.sd / low.mean,
                "SD / mean at 30 %": high.sd / high.mean,
                "p of UARD against baseline at 0 % noise": quiet[1],
            },
            "not significantly, and relative to the mean it falls",
            False,
            ("J25", "G11"),
        ),
        Check(
            "h.gradients",
            "From which lambda U on has the reciprocal filter the larger slope than the exponential one?",
            {"reciprocal": "preserves gradients under high uncertainty", "lambda U at the trap": x},
            {
                "lambda U": crossing,
                "exponential slope at 1.247": math.exp(-x),
                "reciprocal slope at 1.247": (1.0 + x) ** -2,
            },
            "from 2.51; at the paper's own trap the exponential has the larger slope",
            False,
            ("J13", "J14"),
        ),
        Check(
            "h.settings",
            "Do horizon, goal and exploration fit together?",
            {"horizon": "scaled proportionally to grid size", "goal": "(9, 9)", "epsilon floor": floor},
            {f"steps per side, {n}": paper.HORIZON[n] / n for n in SIZES}
            | {"sizes that (9, 9) is outside of": ", ".join(map(str, off))}
            | {
                "epsilon in episode 500": factor ** (paper.EPISODES - 1),
                "episode that reaches the floor": float(1 + math.ceil(math.log(floor) / math.log(factor))),
            },
            "no: not proportional, the goal lies outside of two grids, and the floor is never reached",
            False,
            ("B1", "B4", "E9"),
        ),
        Check(
            "h.nine",
            "Are there results for nine baselines?",
            {"baselines": float(len(paper.BASELINES))},
            {"with numbers in a table": float(len(tabled)), "without any result": ", ".join(nowhere)},
            "four have numbers, four more are named in figures, Ensemble-DQN in none",
            False,
            ("J24", "D10"),
        ),
        Check(
            "h.timing",
            "When does UARD's return settle, and on what?",
            {
                "transition to the goal (L1143), episode": paper.TEXT["transition episode"].value,
                "true return stable (L1947), from episode": paper.TEXT["avoidance episode"].value,
                "at": _number(paper.FIGURES["G8"].numbers["UARD"]),
            },
            {"return of the way to the goal": _straight_return(6)},
            "settled at -4.0 from episode 200 means that it never arrives; a turn to the goal at 400 that it does",
            False,
            ("J26", "J27", "G3", "G8"),
        ),
        Check(
            "h.reference",
            "Does the reference policy reach the thresholds that it is said to justify?",
            {name: paper.TEXT[f"{name} objective"].value for name in ("Walker2d", "Hopper")},
            {name: paper.TEXT[f"{name} reference"].value for name in ("Walker2d", "Hopper")},
            "neither mean does",
            False,
            ("J36", "B9"),
        ),
        Check(
            "h.energy",
            "Does 150 GPU-hours fit 30 to 45 kWh?",
            {"kWh low": paper.TEXT["kWh low"].value, "kWh high": paper.TEXT["kWh high"].value},
            {
                "kW low": paper.TEXT["kWh low"].value / hours,
                "kW high": paper.TEXT["kWh high"].value / hours,
                "kWh at the card's 350 W": hours * 0.35,
            },
            "only at 200 to 300 W",
            None,
            ("E15", "K17"),
        ),
    ]


def fewest_events(percent: float, decimals: int = 1) -> tuple[int, int]:
    """Return the smallest (remaining, all) counts whose reduction prints as ``percent``."""
    total = 1
    while True:
        for left in range(total + 1):
            if abs(round(100.0 * (1.0 - left / total), decimals) - percent) < 1e-9:
                return left, total
        total += 1


def edac_sunrise() -> list[Check]:
    """Section i: the comparisons with EDAC and SUNRISE (G14, G15)."""
    percent = paper.PERCENT["exploits"].value
    left, total = fewest_events(percent)
    g15 = paper.FIGURES["G15"].numbers
    spike, gap = _number(g15["SUNRISE above"]), _number(g15["gap"])
    return [
        Check(
            "i.counts",
            "How many activations must EDAC have for 92.0 % fewer?",
            {"reduction %": percent, "spikes named": _number(paper.FIGURES["G14"].numbers["spikes"])},
            {"EDAC at least": float(total), "UARD then": float(left)},
            "25; the text and the caption know of three",
            False,
            ("J22", "A49", "G14"),
        ),
        Check(
            "i.sunrise",
            "Do a reward of 1.4, a gap of 1.6 and 'more than five times' fit?",
            {"ratio above": _number(g15["ratio above"]), "UARD below": _number(g15["UARD below"])},
            {
                "UARD's reward if SUNRISE's is 1.4": round(spike - gap, 9),
                "SUNRISE's reward for five times": gap * 5.0 / 4.0,
                "UARD's reward then": gap / 4.0,
            },
            "only if the spike is between 1.6 and 2.0; at the 1.4 that is named, UARD's reward would be negative",
            None,
            ("J23", "J44", "G15"),
        ),
    ]


SECTIONS: dict[str, Callable[[], list[Check]]] = {
    "0": readings,
    "a": table_3,
    "a2": table_2,
    "b": table_4,
    "c": significance,
    "d": annotators,
    "e": negative_values,
    "f": operator,
    "g": sign_preservation,
    "h": consistency,
    "i": edac_sunrise,
}


def run() -> list[Check]:
    """Do the whole audit; takes a few seconds."""
    return [check for section in SECTIONS.values() for check in section()]
