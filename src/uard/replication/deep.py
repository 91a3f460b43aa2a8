"""Tables, figures and findings of the deep studies, from the published results."""

from __future__ import annotations

import numpy as np

from uard.lab import statistics
from uard.lab.result import CALIBRATION, RATING_ERROR
from uard.lab.study import Row
from uard.lab.trainers.examine import WINDOWS
from uard.lab.views.figures import Chart, Picture, made_by
from uard.lab.views.losses import Loss, of_family
from uard.lab.views.palette import DASHED, DOTTED, look
from uard.lab.views.published import BIN, Published, packaged_json
from uard.lab.views.tables import Cell, Table, brief
from uard.replication import distortion, figures, paper
from uard.replication.studies.derive import SIGMA_QUALITY

AGENT = {"DQN": "dqn", "CQL": "cql", "CPO": "cpo", "TRPO": "trpo"}  # of the paper's Table 3
OURS = "uard"


def tables(p: Published) -> list[Table]:
    """Return all tables for which there are results."""
    made = [_baselines(p), _competence(p), _mitigated(p), _rivals(p), _ablation(p), _ensembles(p), _feedback(p)]
    made += [_distortion(p), _credentials(), _speed()]
    return [t for t in made if t.rows]


def _visits(p: Published, r: Row) -> str:
    return brief(p.of(r, "hacks"))


def _baselines(p: Published) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for printed in paper.TABLE_3:
        mean, sd = printed.visits.mean / 100, printed.visits.sd / 100
        rows.append((printed.method, "paper", f"{mean:.1f} ± {sd:.2f}", f"{printed.reward.mean:g}", "–", "–"))
    for r in p.rows("deep-baselines"):
        who = r["agent"] if r["mitigation"] == "raw" else f"{r['agent']} + {r['mitigation']}"
        s = [p.of(r, m) for m in ("hacks", "observed_return", "success_rate", "true_return")]
        rows.append((who, f"ours, T = {r['horizon']}", *s))
    return Table(
        "Table 3 (F3) with the deep baselines: 10x10, +4, per episode over the last 100 of 500",
        ("method", "source", "trap visits", "observed return", "goal rate", "true return"),
        tuple(rows) if p.rows("deep-baselines") else (),
        2,
        "Same network, budget and reward stream for all (J35). cpo sees no cost, as the paper's evidently was; "
        "cpo-oracle sees every hack, which no learner could know.",
    )


def _competence(p: Published) -> Table:
    rows = []
    for r in p.rows("deep-competence"):
        rows.append((r["agent"], *(p.of(r, m) for m in ("success_rate", "true_return", "hacks"))))
    return Table(
        "Control: the same agents on the true reward of 10x10, T = 100",
        ("agent", "goal rate", "true return", "trap visits"),
        tuple(rows),
        1,
        "An agent that does not learn the grid in the paper's 500 episodes even from the truth proves nothing by not hacking.",
    )


def _mitigated(p: Published) -> Table:
    rows = []
    for r in p.rows("deep-uard"):
        s = [p.of(r, m) for m in ("hacks", "success_rate", "true_return")]
        rows.append((r["agent"], f"{r['trap']:+g}", r["panel"], r["mitigation"], *s))
    return Table(
        "Every agent with uard and uard-0.1, 10x10, T = 100, one setting of each, ratings through a learned model",
        ("agent", "trap", "panel", "mitigation", "trap visits", "goal rate", "true return"),
        tuple(rows),
        4,
        "uard learns the gap between each rater and the reward, uard-0.1 what all raters say together.",
    )


def _rivals(p: Published) -> Table:
    rows = []
    for r in p.rows("deep-rivals"):
        s = [p.of(r, m) for m in ("hacks", "true_return", "success_rate")]
        rows.append((r["agent"], r["panel"], r["mitigation"], *s))
    return Table(
        "Other mitigations in deep agents: 10x10, +4, T = 80, every rater with noise of sd 1.2",
        ("agent", "panel", "mitigation", "trap visits", "true return", "goal rate"),
        tuple(rows),
        3,
        "All of them listen to one model of each rater: rules are compared here, not models.",
    )


def matched(p: Published) -> list[Loss]:
    """Say for each agent and panel which rival earns more than ``uard`` among those that hack no more than it.

    A rival counts as matched if its hack rate is not above ``uard``'s. All rivals, agents and panels are one family of
    paired tests for hacks, and one for true returns (Holm).
    """
    every = [
        (x, r)
        for r in p.rows("deep-rivals", mitigation=OURS)
        for x in p.rows("deep-rivals", agent=r["agent"], panel=r["panel"])
        if x is not r
    ]
    hacking, returns = (p.compare(every, metric) for metric in ("hacks", "true_return"))
    out = []
    for i, (rival, r) in enumerate(every):
        own, theirs = (p.of(x, "true_return") for x in (r, rival))
        if hacking.above(i) or theirs.mean <= own.mean or returns.tests[i] is None:
            continue
        name = rival["mitigation"]
        told = returns.above(i)
        what = f"{name} earns more and hacks no more" if told else f"{name} has a higher mean and hacks no more"
        numbers = (name, own, theirs, "true return", *of_family(returns, i))
        where = f"{r['agent']}, {r['panel']} panel, very noisy raters"
        out.append(Loss("beaten" if told else "no better", "deep agents", what, where, *numbers))
    return out


def losses(p: Published) -> list[Loss]:
    """Say where ``uard`` fails or is beaten in deep agents, found by rule."""
    return [*_missed(p), *matched(p), *_of_sources(p), *_lost_goals(p)]


def _missed(p: Published) -> list[Loss]:
    """Settings in which ``uard`` misses 95 % goals or half a visit, and agents that miss goals on the true reward."""
    unable = {r["agent"]: r for r in p.rows("deep-competence") if p.of(r, "success_rate").mean < 0.95}
    out = []
    for r in p.rows("deep-uard", mitigation=OURS):
        hacks, goals = (p.of(r, m) for m in ("hacks", "success_rate"))
        where = f"{r['agent']}, 10x10, trap {r['trap']:+g}, {r['panel']} panel"
        if hacks.mean > 0.5:
            out.append(Loss("fails", "deep agents", "more than half a trap visit", where, ours=hacks, metric="hacks"))
        if goals.mean < 0.95:
            reference = unable.get(r["agent"])
            theirs = None if reference is None else p.of(reference, "success_rate")
            who, why = ("", "") if theirs is None else ("true reward", "the agent misses them on the true reward, too")
            what = "less than 95 % goals"
            out.append(Loss("fails", "deep agents", what, where, who, goals, theirs, "goal rate", why=why))
    return out


def _of_sources(p: Published) -> list[Loss]:
    """Say where the learned model of the ratings does worse than a table of them."""
    pairs = [
        (r, model)
        for r in p.rows("deep-feedback", source="table")
        for model in p.rows("deep-feedback", source="model", rated=r["rated"], mitigation=r["mitigation"])
    ]
    family = p.compare(pairs, "true_return")
    return [
        Loss(
            "beaten",
            "deep agents",
            f"{r['mitigation']} with a model of the ratings earns less than with a table",
            f"ensemble-dqn, {100 * r['rated']:g} % of the steps rated",
            "a table of ratings",
            p.of(model, "true_return"),
            p.of(r, "true_return"),
            "true return",
            *of_family(family, i),
            why="the model extrapolates what few ratings do not support",
        )
        for i, (r, model) in enumerate(pairs)
        if family.above(i)
    ]


def _lost_goals(p: Published) -> list[Loss]:
    """Say in which settings ``uard`` has runs that no longer find the goal."""
    settings = [
        (r, f"{r['agent']}, {r['panel']} panel, very noisy raters") for r in p.rows("deep-rivals", mitigation=OURS)
    ]
    settings += [
        (r, f"ensemble-dqn, a {r['source']} of the ratings, {100 * r['rated']:g} % rated")
        for r in p.rows("deep-feedback", mitigation=OURS)
    ]
    out = []
    for r, where in settings:
        goals = p.per_seed(r, "success_rate")
        if lost := int((goals < 0.5).sum()):
            what = f"{lost} of {len(goals)} runs lose the goal"
            out.append(Loss("fails", "deep agents", what, where, ours=p.of(r, "success_rate"), metric="goal rate"))
    return out


def _ablation(p: Published) -> Table:
    rows = []
    for r in p.rows("deep-ablation"):
        s = [p.of(r, m) for m in ("hacks", "success_rate", "true_return")]
        rows.append((r["variant"], r["reading"], *s))
    return Table(
        "Table 5 (F5) with deep agents: 6x6, main panel",
        ("variant", "where the filter acts", "trap visits", "goal rate", "true return"),
        tuple(rows),
        2,
        "Ensemble-DQN; as printed (acts on J) and as recommended. Our human-only and UARD differ by sigma_m alone.",
    )


def _ensembles(p: Published) -> Table:
    speed = {row["name"]: row["cost_of_single"] for row in (packaged_json("speed.json") or {"rows": []})["rows"]}
    cost = {"full": "5 full networks", "shared": "5 heads, shared trunk", "dropout": "dropout, 5 passes"}
    rows = []
    for r in p.rows("deep-ensembles"):
        quality = p.derived(r, "sigma_m")
        got = [statistics.summarise(quality[:, i]) for i in range(len(SIGMA_QUALITY))]
        name = cost.get(r["ensemble"].split(",")[0], "")
        rows.append((r["ensemble"], speed.get(name), *got, p.of(r, "hacks")))
    return Table(
        "Kinds of ensembles (K4, K9): cost, and what their sigma_m knows",
        (
            "ensemble of 5",
            "cost of a step, single network = 1",
            "AUROC: never tried",
            "Spearman with |mu - Q*|",
            "trap visits",
        ),
        tuple(rows),
        1,
        "6x6, raw reward. AUROC: chance that a state-action never tried has the larger sigma_m than one that was. Q* is "
        "exact. Costs are measured without feedback (benchmarks/deep.py).",
    )


def _feedback(p: Published) -> Table:
    rows = []
    for r in p.rows("deep-feedback"):
        errors, ranks = p.derived(r, "rating_error"), p.derived(r, "calibration")
        got = [statistics.summarise(errors[:, i]) for i in range(len(RATING_ERROR))]
        auroc = statistics.summarise(ranks[:, CALIBRATION.index("auroc_with_proxy")])
        visits, true = (p.of(r, m) for m in ("hacks", "true_return"))
        rows.append((r["mitigation"], r["source"], f"{100 * r['rated']:g} %", *got, auroc, visits, true))
    return Table(
        "What the learner knows of its raters: running means, or a model of the ratings (10x10, main panel)",
        ("mitigation", "source", "rated", "mean, rated", "mean, unrated", "sigma_h, rated", "sigma_h, unrated", "AUROC count",
         "AUROC hack", "trap visits", "true return"),
        tuple(rows),
        3,
        "Errors are root mean squares against what the panel would say, in reward units, over state-actions that were rated "
        "and that never were. AUROC count: does the model know which are which? AUROC hack: sigma_h (proxy counted) as a detector.",
    )  # fmt: skip


def _distortion(p: Published) -> Table:
    rows = []
    for r in p.rows("deep-distortion"):
        count, largest, mean = (
            statistics.summarise(p.derived(r, n)) for n in ("activations", "largest", "mean_inside")
        )
        rows.append((r["agent"], count, largest, mean))
    return Table(
        "A distorted reward after training (H15, H16; our definitions)",
        ("agent", "exploit activations of 60", "largest adjusted reward", "mean adjusted reward in the windows"),
        tuple(rows),
        1,
        f"+{distortion.BONUS} on the observed reward in three windows of 20 steps; an activation is an adjusted reward above "
        f"{distortion.THRESHOLD}. Raters tell the truth; EDAC and SUNRISE read no ratings, so this is no fair fight.",
    )


LIBRARIES = {"stable-baselines3": "Stable-Baselines3", "sbx-rl": "SBX"}


def _credentials() -> Table:
    data = packaged_json("credentials.json") or {"rows": []}
    rows = []
    for row in data["rows"]:
        if "returns" in row:
            who = "ours" if row["who"] == "ours" else LIBRARIES[row.get("library", "stable-baselines3")]
            seeds, returned = str(len(row["returns"])), statistics.summarise(row["returns"])
        else:
            who, seeds, returned = row["who"], None, f"{row['mean']} ± {row['sd']}"
        rows.append((row["task"], row["agent"], who, seeds, f"{row['budget']:,}", returned))
    return Table(
        "Credentials: returns beside Stable-Baselines3, sb3-contrib, SBX and published ones",
        ("task", "agent", "whose", "seeds", "steps", "return"),
        tuple(rows),
        3,
        "Mean return of training episodes in the last fifth of the budget (benchmarks/credentials.py). Hopper and "
        "Walker2d are the uncorrupted v4 tasks; the published numbers are of the last episodes.",
    )


def _speed() -> Table:
    data = packaged_json("speed.json") or {"rows": [], "matrix_rate": 1.0}
    rows = tuple(
        (
            r["name"],
            r["steps_per_second"],
            f"{r['range'][0]:,.0f} to {r['range'][1]:,.0f}".replace(",", " "),
            r["us_per_step"],
            r["floor_us"],
            r["times_sb3"],
            r["cost_of_single"],
        )
        for r in data["rows"]
    )
    return Table(
        "Speed of DQN on 10x10, one update per step, one core, one run",
        ("what", "steps per second", "range", "µs per step", "floor, µs", "times SB3", "cost, single = 1"),
        rows,
        1,
        f"Floor: arithmetic of an update at the machine's {data['matrix_rate'] / 1e9:.0f} GFLOP/s (benchmarks/deep.py).",
    )


def drawn(p: Published) -> list[Picture]:
    """Return all pictures for which there are results."""
    command = made_by(p.sources, "grid-deep", "uard reproduce grid-deep")
    made = []
    if p.rows("deep-baselines", horizon=100):
        made.append(_curves(p, command))
    if len(p.rows("deep-distortion")) == 3:
        windows = (
            "Seed 0. Shaded: the windows in which the observed reward is inflated. Arrivals at the goal are left out."
        )
        made.append(
            _adjusted(p).picture(
                "g14-g15",
                "G14, G15 · confidence-adjusted reward under distortion",
                f"See which line leaves the dotted bound in the shaded windows: it believes the inflated reward. {windows}",
                command,
            )
        )
        made.append(
            figures.hacking_region(_trace(p, "uard-0.1"), WINDOWS).picture(
                "g12",
                "G12 · a hacking region, and lambda_t",
                f"See lambda_t (below) rise where the reward contradicts the raters, and our reward (above) stay. {windows}",
                command,
            )
        )
    return made


def _curves(p: Published, command: str) -> Picture:
    columns = ("observed_return", "hacks")
    chart = Chart(
        ["Observed return", "Trap visits"], "episode", ["observed return per episode", "trap visits per episode"],
        height=4.2,
    )  # fmt: skip
    for i, column in enumerate(columns):
        for r in p.rows("deep-baselines", horizon=100):
            curve = p.curves(r, column).mean(0)
            raw = r["mitigation"] == "raw"
            label = r["agent"] if raw else f"{r['agent']} + {r['mitigation']}"
            x = (np.arange(len(curve)) + 1) * BIN
            how = (
                look(r["agent"])
                if raw
                else look(r["mitigation"])._replace(dash=DOTTED if r["agent"] == "ppo" else DASHED)
            )
            chart.line(i, x, curve, label, look_of=how)
    return chart.picture(
        "g16-deep",
        "G16 · observed return of all deep agents, 10x10, T = 100",
        "See that the agents with the highest observed return (left) are those that stay in the traps (right). Lines are "
        f"means over {p.seeds('deep-baselines')} seeds, in groups of {BIN} episodes.",
        command,
    )


def _trace(p: Published, agent: str) -> np.ndarray:
    """Return seed 0's trace; arrivals at the goal, ten times everything else, are left out."""
    (r,) = p.rows("deep-distortion", agent=agent)
    trace = p.derived(r, "trace")
    trace[:, trace[0] > 5.0] = np.nan
    return trace


def _adjusted(p: Published) -> Chart:
    rivals = {name: _trace(p, name)[1] for name in ("edac", "sunrise")}
    return figures.adjusted_reward(rivals, _trace(p, "uard-0.1")[1], "uard-0.1", WINDOWS, distortion.THRESHOLD)
