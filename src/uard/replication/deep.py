"""Tables, figures and findings of the deep studies, from the published results."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from uard.lab import statistics
from uard.lab.result import CALIBRATION, RATING_ERROR
from uard.lab.study import Row
from uard.lab.trainers.examine import WINDOWS
from uard.lab.views.figures import COLOURS as PALETTE
from uard.lab.views.figures import axes_of, data_uri
from uard.lab.views.published import BIN, Published, packaged_json
from uard.lab.views.tables import Table, brief, full
from uard.replication import distortion, figures, paper
from uard.replication.studies.derive import SIGMA_QUALITY

AGENT = {"DQN": "dqn", "CQL": "cql", "CPO": "cpo", "TRPO": "trpo"}  # of the paper's Table 3
OURS = "uard"
COLOURS = {
    "dqn": "#c1272d", "ensemble-dqn": "#e08214", "cql": "#8c6d31", "sunrise": "#d6589f", "ppo": "#2c6fbb",
    "trpo": "#17a2b8", "cpo": "#7b4fa3", "cpo-oracle": "#b9a0d0", "sac": "#444444", "edac": "#999933",
}  # fmt: skip


def tables(p: Published) -> list[Table]:
    """Return all tables for which there are results."""
    made = [_baselines(p), _competence(p), _mitigated(p), _rivals(p), _ablation(p), _ensembles(p), _feedback(p)]
    made += [_distortion(p), _credentials(), _speed()]
    return [t for t in made if t.rows]


def _visits(p: Published, r: Row) -> str:
    return brief(p.of(r, "hacks"))


def _baselines(p: Published) -> Table:
    rows: list[tuple[str, ...]] = []
    for printed in paper.TABLE_3:
        mean, sd = printed.visits.mean / 100, printed.visits.sd / 100
        rows.append((printed.method, "paper", f"{mean:.1f} ± {sd:.2f}", f"{printed.reward.mean:g}", "–", "–"))
    for r in p.rows("deep-baselines"):
        who = r["agent"] if r["mitigation"] == "raw" else f"{r['agent']} + {r['mitigation']}"
        s = [brief(p.of(r, m)) for m in ("hacks", "observed_return", "success_rate", "true_return")]
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
        rows.append((r["agent"], *(full(p.of(r, m)) for m in ("success_rate", "true_return", "hacks"))))
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
        s = [full(p.of(r, m)) for m in ("hacks", "success_rate", "true_return")]
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
        s = [full(p.of(r, m)) for m in ("hacks", "true_return", "success_rate")]
        rows.append((r["agent"], r["panel"], r["mitigation"], *s))
    return Table(
        "Other mitigations in deep agents: 10x10, +4, T = 80, every rater with noise of sd 1.2",
        ("agent", "panel", "mitigation", "trap visits", "true return", "goal rate"),
        tuple(rows),
        3,
        "All of them listen to one model of each rater: rules are compared here, not models.",
    )


def matched(p: Published) -> list[str]:
    """Say for each agent and panel whether ``uard`` has the highest true return among those that hack no more than it.

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
    more = [x for i, (x, _) in enumerate(every) if hacking.above(i)]
    richer = [x for i, (x, _) in enumerate(every) if returns.above(i)]
    out = []
    for agent in dict.fromkeys(r["agent"] for r in p.rows("deep-rivals")):
        for panel in ("main", "appendix"):
            group = p.rows("deep-rivals", agent=agent, panel=panel)
            mine = [r for r in group if r["mitigation"] == OURS]
            if not mine:
                continue
            equals = [r for r in group if r is not mine[0] and r not in more]
            own = p.of(mine[0], "true_return")
            better = [r for r in equals if r in richer]
            higher = [r for r in equals if p.of(r, "true_return").mean > own.mean and r not in better]
            names = ", ".join(r["mitigation"] for r in equals)
            rivals = f"matched in hack rate by {names}" if names else "no rival hacks as rarely"
            text = f"{agent}, {panel} panel, very noisy raters: {rivals}; uard's true return {full(own)}"
            if better:
                text += "; it is beaten by " + ", ".join(
                    f"{r['mitigation']} {full(p.of(r, 'true_return'))}" for r in better
                )
            elif higher:
                text += "; not told apart from " + ", ".join(
                    f"{r['mitigation']} {full(p.of(r, 'true_return'))}" for r in higher
                )
            else:
                text += "; the highest"
            out.append(text + ".")
    return [*out, f"Deep rivals, true return against uard: {returns.caption()}"] if every else out


def losses(p: Published) -> list[str]:
    """Say where ``uard`` fails or is beaten in deep agents, found by rule."""
    settings = p.rows("deep-uard", mitigation=OURS)
    missed = [
        f"{r['agent']} {r['trap']:+g} {r['panel']}: visits {_visits(p, r)}, goal {brief(p.of(r, 'success_rate'))}"
        for r in settings
        if p.of(r, "hacks").mean > 0.5 or p.of(r, "success_rate").mean < 0.95
    ]
    out = []
    if settings:
        text = (
            f"Deep agents on 10x10: of {len(settings)} settings uard misses 0.5 visits or 95 % goals in {len(missed)}"
        )
        out.append(text + (": " + "; ".join(missed) if missed else "") + ".")
    unable = [r for r in p.rows("deep-competence") if p.of(r, "success_rate").mean < 0.95]
    if unable:
        goals = "; ".join(f"{r['agent']} {brief(p.of(r, 'success_rate'))}" for r in unable)
        out.append(
            f"On the true reward of 10x10 these agents miss 95 % goals in the paper's budget, so what they do there with uard says little: {goals}."
        )
    out += matched(p)
    return [*out, *_of_sources(p), *_lost_goals(p)]


def _of_sources(p: Published) -> list[str]:
    """Say where the learned model of the ratings does worse than a table of them."""
    pairs = [
        (r, model)
        for r in p.rows("deep-feedback", source="table")
        for model in p.rows("deep-feedback", source="model", rated=r["rated"], mitigation=r["mitigation"])
    ]
    family = p.compare(pairs, "true_return")
    out = []
    for i, (r, model) in enumerate(pairs):
        if family.above(i):
            table, learned = (full(p.of(x, "true_return")) for x in (r, model))
            out.append(
                f"{r['mitigation']} with {100 * r['rated']:g} % of steps rated: the learned model of the ratings does worse than "
                f"a table of running means: {learned} against {table}. Here it extrapolates what few ratings do not support. "
                f"{family.caption()}"
            )
    return out


def _lost_goals(p: Published) -> list[str]:
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
            out.append(f"{OURS} lost the goal in {lost} of {len(goals)} runs: {where}.")
    return out


def _ablation(p: Published) -> Table:
    rows = []
    for r in p.rows("deep-ablation"):
        s = [full(p.of(r, m)) for m in ("hacks", "success_rate", "true_return")]
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
        got = [full(statistics.summarise(quality[:, i])) for i in range(len(SIGMA_QUALITY))]
        name = cost.get(r["ensemble"].split(",")[0], "")
        price = f"{speed[name]:.2f}" if name in speed else "–"
        rows.append((r["ensemble"], price, *got, _visits(p, r)))
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
        got = [brief(statistics.summarise(errors[:, i])) for i in range(len(RATING_ERROR))]
        auroc = brief(statistics.summarise(ranks[:, CALIBRATION.index("auroc_with_proxy")]))
        visits, true = (brief(p.of(r, m)) for m in ("hacks", "true_return"))
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
        rows.append((r["agent"], full(count), full(largest), full(mean)))
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
            seeds, returned = str(len(row["returns"])), full(statistics.summarise(row["returns"]))
        else:
            who, seeds, returned = row["who"], "–", f"{row['mean']} ± {row['sd']}"
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
            f"{r['steps_per_second']:.0f} ({r['range'][0]:.0f}-{r['range'][1]:.0f})",
            f"{r['us_per_step']:.0f}",
            f"{r['floor_us']:.0f}",
            f"{r['times_sb3']:.1f}",
            f"{r['cost_of_single']:.2f}",
        )
        for r in data["rows"]
    )
    return Table(
        "Speed of DQN on 10x10, one update per step, one core, one run",
        ("what", "steps/s (range)", "us per step", "floor us", "times SB3", "cost, single = 1"),
        rows,
        1,
        f"Floor: arithmetic of an update at the machine's {data['matrix_rate'] / 1e9:.0f} GFLOP/s (benchmarks/deep.py).",
    )


def drawn(p: Published) -> list[tuple[str, str, str]]:
    """Return (title, what to see, image) of all figures for which there are results."""
    made = []
    if p.rows("deep-baselines", horizon=100):
        note = "Mean over seeds, bins of 10 episodes. A low observed return is no virtue; a high one is the hack."
        made.append(("G16 · observed return of all deep agents, 10x10, T = 100", note, _curves(p)))
    if len(p.rows("deep-distortion")) == 3:
        note = (
            "Seed 0. Shaded: the windows in which the observed reward is inflated. Arrivals at the goal are left out."
        )
        made.append(("G14, G15 · confidence-adjusted reward under distortion", note, _adjusted(p)))
        note = "Left: what each would learn from; right: lambda_t of uard-0.1, which rises where the reward contradicts the raters."
        made.append(
            ("G12 · a hacking region, and lambda_t", note, figures.hacking_region(_trace(p, "uard-0.1"), WINDOWS))
        )
    return [(title, note, data_uri(figure)) for title, note, figure in made]


def _curves(p: Published) -> Figure:
    figure, axes = axes_of(2, 6.2, 4.2)
    for axis, column in zip(axes, ("observed_return", "hacks"), strict=True):
        for r in p.rows("deep-baselines", horizon=100):
            curve = p.curves(r, column).mean(0)
            raw = r["mitigation"] == "raw"
            label = r["agent"] if raw else f"{r['agent']} + {r['mitigation']}"
            colour = COLOURS[r["agent"]] if raw else PALETTE[r["mitigation"]]
            x = (np.arange(len(curve)) + 1) * BIN
            style = "-" if raw else ":" if r["agent"] == "ppo" else "--"
            axis.plot(x, curve, color=colour, lw=1.6 if raw else 2.4, ls=style, label=label)
        axis.set(xlabel="episode", ylabel=column.replace("_", " "))
    axes[1].legend(fontsize=8, ncols=2)
    return figure


def _trace(p: Published, agent: str) -> np.ndarray:
    """Return seed 0's trace; arrivals at the goal, ten times everything else, are left out."""
    (r,) = p.rows("deep-distortion", agent=agent)
    trace = p.derived(r, "trace")
    trace[:, trace[0] > 5.0] = np.nan
    return trace


def _adjusted(p: Published) -> Figure:
    rivals = {name: (_trace(p, name)[1], COLOURS[name]) for name in ("edac", "sunrise")}
    figure = figures.adjusted_reward(rivals, _trace(p, "uard-0.1")[1], "ensemble-dqn + uard-0.1", WINDOWS)
    for axis in figure.axes:
        axis.axhline(distortion.THRESHOLD, color="k", ls=":", lw=1)
    return figure
