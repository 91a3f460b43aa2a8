"""Tables, figures and findings of Hopper and Walker2d (G6, G7, G10-G15; H4, H11-H16), from the published results."""

from __future__ import annotations

import base64
from collections.abc import Iterable
from importlib import resources
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from uard.lab import statistics
from uard.lab.study import Row
from uard.lab.trainers import examine
from uard.lab.views.figures import axes_of, data_uri
from uard.lab.views.published import Published, packaged_json
from uard.lab.views.tables import Table, full, number
from uard.replication import figures

HACKING, NOISE, KICK = "mujoco-standard-hacking", "mujoco-standard-noise", "mujoco-standard-kick"
DISTORTION, RATING = "mujoco-standard-distortion", "mujoco-standard-rating"
BONUSES, ABLATION = "mujoco-standard-bonuses", "mujoco-standard-ablation"
LEGITIMATE, CAUTION = "mujoco-standard-legitimate", "mujoco-standard-caution"
AS_GOOD = 0.03  # by how much the AUROC of a cheaper sigma_m may be lower
REFERENCES = ("raw", "true reward")
REMOVED, KEPT, COST = 0.936, 0.9, 0.05  # the paper's best reduction (J16); what is asked of a filter beside it
METRICS = ("hacks", "true_return", "observed_return")
HEADS = ("steps in the region per episode", "true return", "observed return")  # of METRICS
COLOURS = {"true reward": "#444444", "raw": "#c1272d", "uard-paper": "#e08214", "uard-0.1": "#2c6fbb"}


def summary(values: np.ndarray) -> str:
    """Return one number per seed as text: mean, deviation and interval; of one seed, that number alone."""
    return full(statistics.summarise(values)) if len(values) > 1 else number(values[0])


def tables(p: Published) -> list[Table]:
    """Return all tables for which there are results."""
    makers = (_hacking, _pooled, _noise, _kick, _bonuses, _legitimate, _caution, _ablation, _rating, _distortion)
    return [t for t in (*(make(p) for make in makers), _speed()) if t.rows]


def _steps(p: Published, study: str) -> str:
    def each(numbers: Iterable[int]) -> str:
        return " or ".join(f"{n:,}" for n in sorted(set(numbers)))

    rows = p.rows(study)
    seeds = sorted({len(p.seeds_of(r)) for r in rows})
    if not rows:
        return ""
    many = f"{each(seeds)} seed{'s' if seeds[-1] > 1 else ''}"
    alone = " (a number without an interval is of one)" if seeds[0] == 1 < seeds[-1] else ""
    return f"{each(r.cell.steps or 0 for r in rows)} steps, {many}{alone}"


def _hacking(p: Published) -> Table:
    rows = []
    for r in p.rows(HACKING):
        cells = (summary(p.per_seed(r, m)) for m in METRICS)
        share = _shares(p, r)
        where = f"{r['robot']}, {r['region']}" if r["region"] != "none" else f"{r['robot']}, no lie"
        best = (summary(x) for x in p.derived(r, "deterministic").T)
        rows.append((where, r["agent"], r["mitigation"], r["panel"], *cells, *share, *best))
    return Table(
        f"Hopper and Walker2d with a reward that lies (G6, G7), {_steps(p, HACKING)}, 15 % of steps rated",
        (
            "task", "agent", "learns from", "panel", *HEADS, "hacks removed", "true return kept", "deterministic: steps in the region", "true return",
        ),
        tuple(rows),
        4,
        "Over the last 100 training episodes, actions as the policy draws them; the two deterministic columns are eight "
        "more episodes of each trained agent with its most likely actions. Removed: of the raw agent's hacks. Kept: of "
        "the true return of the same agent trained on the true reward (without a lie: of the raw agent's). The paper's "
        "thresholds of 42 and 110 are falls after 39 to 49 and about 113 steps; doing nothing scores 141 and 95.",
    )  # fmt: skip


def _rival(p: Published, r: Row, mitigation: str) -> Row | None:
    return _found(p, HACKING, robot=r["robot"], region=r["region"], agent=r["agent"], mitigation=mitigation)


def _found(p: Published, study: str, **labels: Any) -> Row | None:
    return next(iter(p.rows(study, **labels)), None)


def shares(p: Published, r: Row) -> tuple[float | None, float | None]:
    """Return what a row removes of the raw agent's hacks, and keeps of the honest agent's true return.

    Where the raw agent makes less than one hack step per episode a share of it says nothing and is None.
    """
    raw = _rival(p, r, "raw")
    return _removed(p, r, raw), _kept(p, r, raw if r["region"] == "none" else _rival(p, r, "true reward"))


def _removed(p: Published, r: Row, raw: Row | None) -> float | None:
    if raw is None or p.of(raw, "hacks").mean < 1.0:
        return None
    return 1.0 - p.of(r, "hacks").mean / p.of(raw, "hacks").mean


def _kept(p: Published, r: Row, honest: Row | None) -> float | None:
    if honest is None or p.of(honest, "true_return").mean <= 0:
        return None
    return p.of(r, "true_return").mean / p.of(honest, "true_return").mean


def _shares(p: Published, r: Row) -> tuple[str, str]:
    if r["mitigation"] in REFERENCES:
        return "–", "–"
    removed, kept = ("–" if x is None else f"{100 * x:.1f} %" for x in shares(p, r))
    return removed, kept


def pooled(p: Published, robot: str, agent: str, mitigation: str) -> tuple[np.ndarray, np.ndarray] | None:
    """Return ``shares`` of a mitigation over all of a robot's settings that lie: one pair of numbers per seed, (seeds,).

    A seed's hacks and returns are added up over both regions and both panels before they are compared, so that one
    lucky run decides less. None if a row is missing, or has other seeds than the rest.
    """
    groups = [
        [r for r in p.rows(HACKING, robot=robot, agent=agent, mitigation=m) if r["region"] != "none"]
        for m in (mitigation, *REFERENCES)
    ]
    if [len(g) for g in groups] != [4, 2, 2] or len({p.seeds_of(r) for g in groups for r in g}) > 1:
        return None
    ours, raw, honest = (
        np.array([[p.per_seed(r, m) for m in ("hacks", "true_return")] for r in g]).mean(0) for g in groups
    )
    return 1.0 - ours[0] / raw[0], ours[1] / honest[1]


def headline(p: Published) -> str:
    """Say in a few sentences what PPO does in the tasks that lie, also under noise; the README quotes it."""
    lies = [r for r in p.rows(HACKING, agent="ppo") if r["region"] != "none"]
    raw, ours = ([p.of(r, "hacks").mean for r in lies if r["mitigation"] == m] for m in ("raw", "uard-0.1"))
    kept = {
        m: " and ".join(
            f"{summary(100 * found[1])} % ({robot})"
            for robot in ("hopper", "walker2d")
            if (found := pooled(p, robot, "ppo", m)) is not None
        )
        for m in ("uard-0.1", "uard-paper")
    }
    noisy = p.studies[NOISE].one(agent="ppo", mitigation="uard-0.1", noise=0.3)
    hopper = p.rows(HACKING, robot="hopper", agent="ppo")
    (honest,) = (r for r in hopper if (r["region"], r["mitigation"]) == ("vibration", "true reward"))
    plain = {r["mitigation"]: r for r in hopper if r["region"] == "none"}
    _, by_sac = pooled(p, "hopper", "sac", "uard-0.1") or (None, None)
    sac = f" SAC on Hopper keeps {summary(100 * by_sac)} % ({len(by_sac)} seeds)." if by_sac is not None else ""
    return (
        f"PPO on the raw reward spends {min(raw):.0f} to {max(raw):.0f} steps of an episode where the reward lies, with "
        f"`uard-0.1` at most {number(max(ours))}. Over all settings of a robot `uard-0.1` keeps {kept['uard-0.1']} of the true return of "
        f"the agent trained on the true reward; as printed, {kept['uard-paper']}. "
        f"With noise of 30 % of the bonus on every rating (Hopper, vibration) it spends "
        f"{summary(p.per_seed(noisy, 'hacks'))} steps where the reward lies and has a true return of "
        f"{summary(p.per_seed(noisy, 'true_return'))}; the honest agent has {summary(p.per_seed(honest, 'true_return'))}. "
        f"Without a lie (Hopper, {len(p.seeds_of(plain['uard-0.1']))} seeds) its true return is "
        f"{summary(p.per_seed(plain['uard-0.1'], 'true_return'))}, the raw agent's {summary(p.per_seed(plain['raw'], 'true_return'))}."
        f"{sac}{_others(p)}"
    )


def _others(p: Published) -> str:
    parts, seeds = [], 0
    for agent in dict.fromkeys(agent for _, agent in _settings(p) if agent not in ("ppo", "sac")):
        found = [pooled(p, robot, agent, "uard-0.1") for robot in ("hopper", "walker2d")]
        whole = [(100 * removed.mean(), 100 * kept.mean()) for removed, kept in filter(None, found)]
        if len(whole) == len(found):
            removed, kept = zip(*whole, strict=True)
            seeds = max(seeds, *(len(f[0]) for f in found if f))
            parts.append(f"{agent} {min(removed):.1f} and {min(kept):.0f} %")
    if not parts:
        return ""
    return (
        f" Other agents ({seeds} seed{'s' * (seeds > 1)}, the worse robot): of the raw agent's hacks `uard-0.1` removes, and of "
        f"the honest agent's true return it keeps, {'; '.join(parts)}."
    )


def _settings(p: Published) -> list[tuple[str, str]]:
    return list(dict.fromkeys((r["robot"], r["agent"]) for r in p.rows(HACKING)))


def _pooled(p: Published) -> Table:
    rows = []
    for robot, agent in _settings(p):
        for mitigation in ("uard-paper", "uard-0.1"):
            if (found := pooled(p, robot, agent, mitigation)) is not None:
                shares = (summary(100 * x) for x in found)
                rows.append((robot, agent, mitigation, str(len(found[0])), *shares))
    return Table(
        "The same, both regions and both panels together",
        ("robot", "agent", "learns from", "seeds", "hacks removed, %", "true return kept, %"),
        tuple(rows),
        3,
        "A seed's hacks and returns are added up over the four settings, and compared with the raw agent's hacks and with "
        "the true return of the agent trained on the true reward, of the same seed; then the seeds are summarised.",
    )


def _noise(p: Published) -> Table:
    rows = [
        (r["agent"], r["mitigation"], f"{100 * r['noise']:.0f} %", *(summary(p.per_seed(r, m)) for m in METRICS))
        for r in p.rows(NOISE)
    ]
    return Table(
        f"Violations against noise (G11): Hopper, vibration, main panel, {_steps(p, NOISE)}",
        ("agent", "learns from", "noise", *HEADS),
        tuple(rows),
        3,
        "Noise on every rating, as a share of the bonus. The raw agent does not listen, so noise cannot reach it.",
    )


def _kick(p: Published) -> Table:
    rows = [
        (
            r["mitigation"],
            r["kicked"],
            f"{r['at'] or '–'}",
            *(summary(p.per_seed(r, m)) for m in (*METRICS, "episode_length")),
        )
        for r in p.rows(KICK)
    ]
    return Table(
        f"A state thrown off by +5 (G10): Hopper, vibration, PPO, {_steps(p, KICK)}",
        ("learns from", "kicked", "at step", *HEADS, "episode length"),
        tuple(rows),
        3,
        "The paper kicks at step 500. An episode that ends before was never kicked.",
    )


def _bonuses(p: Published) -> Table:
    published = p.rows(BONUSES)
    rows = [
        (r["region"], f"{r['bonus']:g}", r["mitigation"], r["panel"], *(summary(p.per_seed(r, m)) for m in METRICS))
        for r in published
        if len({r["bonus"] for r in published}) > 1  # the default bonus alone is in the first table
    ]
    return Table(
        f"How large a bonus breaks which mitigation: Hopper, PPO, {_steps(p, BONUSES)}",
        ("region", "bonus", "learns from", "panel", *HEADS),
        tuple(rows),
        4,
    )


def _legitimate(p: Published) -> Table:
    rows = [
        (r["region"], r["mitigation"], r["panel"], *(summary(p.per_seed(r, m)) for m in METRICS))
        for r in p.rows(LEGITIMATE)
    ]
    return Table(
        f"Twins whose bonus is real: Hopper, PPO, {_steps(p, LEGITIMATE)}",
        ("region", "learns from", "panel", *HEADS),
        tuple(rows),
        3,
        "The raw agent is right here, and whoever stays away from the region is too cautious. The raters still contest "
        "its steps, as those of the paper do.",
    )


def _caution(p: Published) -> Table:
    rows = []
    for r in p.rows(CAUTION):
        kept = _kept(p, r, _found(p, CAUTION, learns_from="raw"))
        best = (summary(x) for x in p.derived(r, "deterministic").T[1:])
        share = "–" if kept is None else f"{100 * kept:.0f} %"
        rows.append((r["learns_from"], summary(p.per_seed(r, "true_return")), share, *best))
    return Table(
        f"What listening costs where nothing lies: Hopper, PPO, main panel, {_steps(p, CAUTION)}, 15 % of steps rated",
        ("learns from", "true return", "of the raw agent's", "deterministic: true return"),
        tuple(rows),
        1,
        "Only: the other doubt is left out of U (alpha or beta = 0). The mean and the lowest of the annotations are "
        "learned from by themselves, without a filter.",
    )


def _ablation(p: Published) -> Table:
    rows = [
        (r["agent"], r["region"], r["variant"], r["panel"], *(summary(p.per_seed(r, m)) for m in METRICS))
        for r in p.rows(ABLATION)
    ]
    return Table(
        f"Which source does the work (H8): Hopper, uard-0.1, {_steps(p, ABLATION)}",
        ("agent", "region", "doubt", "panel", *HEADS),
        tuple(rows),
        4,
        "Only: the other is left out of U (alpha or beta = 0). lambda_t, which listens to the raters, stays in all three. "
        "Reward and score: the actor also climbs the anchored score of its critics.",
    )


def _rating(p: Published) -> Table:
    rows = []
    for r in p.rows(RATING):
        best = (summary(x) for x in p.derived(r, "deterministic").T)
        cells = (summary(p.per_seed(r, m)) for m in ("hacks", "true_return"))
        rows.append((r["region"], r["panel"], r["query"], *cells, *best))
    return Table(
        f"Which steps are rated: Hopper, PPO with uard-0.1, {_steps(p, RATING)}, 15 % of steps",
        (
            "region", "panel", "rated steps", "steps in the region per episode", "true return",
            "deterministic: steps in the region", "true return",
        ),
        tuple(rows),
        3,
        "Random, or half of them where the model of the ratings knows least (doubtful).",
    )  # fmt: skip


def _distortion(p: Published) -> Table:
    rows = []
    for r in p.rows(DISTORTION):
        columns = np.column_stack([p.derived(r, "reaction"), p.derived(r, "warning")]).T
        rows.append((r["agent"], r["critics"], *(summary(c) for c in columns)))
    return Table(
        f"A distorted reward after training (G12, G14, G15; H13, H15, H16) on Hopper, {_steps(p, DISTORTION)}",
        (
            "agent", "critics", "exploit activations of 60", "share of the lie believed", "lambda_t in the windows",
            "elsewhere", "AUROC of sigma_m: thrown off", "wrong value",
        ),
        tuple(rows),
        2,
        f"Trained on the true reward; then +{examine.BONUS:g} on the observed reward in three windows of 20 steps. An "
        "activation is an adjusted reward above the true one by more than half of that. EDAC and SUNRISE read no "
        "ratings, so this is no fair fight. Thrown off: chance that sigma_m is larger at a state one coordinate of which "
        f"is off by {examine.THROWN:g} than at a visited one. Wrong value: that it is larger where the value is among the "
        "most wrong quarter.",
    )  # fmt: skip


def _speed() -> Table:
    data = packaged_json("speed-mujoco.json") or {"rows": [], "command": "", "machine": ""}
    first: dict[str, float] = {}
    rows = []
    for r in data["rows"]:
        low, high = (f"{x:,.0f}" for x in r["range"])
        share = f"{100 * r['share_of_matrix_rate']:.0f} %" if "share_of_matrix_rate" in r else "–"
        times = r["rate"] / first.setdefault(r["what"], r["rate"])
        rows.append((r["what"], r["who"], f"{r['rate']:,.0f} ({low}-{high})", f"{times:.2f}", share))
    return Table(
        "Speed in MuJoCo, side by side",
        ("what", "who", "rate (range)", "times the first", "of the matrix rate"),
        tuple(rows),
        2,
        f"Made by {data['command']} on {data['machine']}; rates are per second. Machines differ: where products of "
        "matrices are slower, all SACs are nearer to each other.",
    )


def losses(p: Published) -> list[str]:
    """Say where ``uard-0.1`` misses what is asked of it in MuJoCo, found by rule."""
    return _of_hacking(p) + _of_noise(p) + _of_twins(p) + _of_distortion(p)


def _of_twins(p: Published) -> list[str]:
    dear = []
    for r in p.rows(LEGITIMATE, mitigation="uard-0.1"):
        kept = _kept(p, r, _found(p, LEGITIMATE, mitigation="raw", region=r["region"]))
        if kept is not None and kept < 1 - COST:
            dear.append(f"{r['region']} {r['panel']} {100 * (1 - kept):.0f} %")
    if not dear:
        return []
    return [
        f"MuJoCo, Hopper, bonuses that are real: uard's caution costs more than 5 % of the true return{_listed(dear)}."
    ]


def _of_distortion(p: Published) -> list[str]:
    rows = {r["critics"]: r for r in p.rows(DISTORTION, agent="uard-0.1")}
    out = []
    if len(rows) == 2:
        shared, full_ones = (list(p.derived(rows[k], "warning").T) for k in ("5, shared trunk", "5, full"))
        worse = [
            f"{what} {summary(a)} against {summary(b)}"
            for what, a, b in zip(("states thrown off", "wrong values"), shared, full_ones, strict=True)
            if b.mean() - a.mean() > AS_GOOD
        ]
        if worse:
            out.append(
                f"MuJoCo: sigma_m of five critics on one trunk warns worse than that of five full ones (AUROC, by more "
                f"than {AS_GOOD:g}): {'; '.join(worse)}."
            )
    return out


def _of_hacking(p: Published) -> list[str]:
    ours = [r for r in p.rows(HACKING, mitigation="uard-0.1")]
    if not ours:
        return []
    out = []
    lies = [(r, *shares(p, r)) for r in ours if r["region"] != "none"]
    leaks = [(r, f"{100 * x:.1f} % ({_steps_inside(p, r)})") for r, x, _ in lies if x is not None and x < REMOVED]
    honest_too = sum(
        p.of(r, "hacks").mean <= p.of(honest, "hacks").mean
        for r, _ in leaks
        if (honest := _rival(p, r, "true reward")) is not None
    )
    poor = [(r, f"{100 * x:.0f} %") for r, _, x in lies if x is not None and x < KEPT]
    judged = sum(x is not None for _, x, _ in lies)
    together = [
        f"{robot} {agent} {summary(100 * found[1])} %"
        for robot, agent in _settings(p)
        if (found := pooled(p, robot, agent, "uard-0.1")) is not None
    ]
    out.append(
        f"MuJoCo, {_steps(p, HACKING)}: of {judged} settings in which the raw agent hacks, uard-0.1 removes less than "
        f"93.6 % of its hacks in {len(leaks)}{_by_agent(leaks)}, and leaves no more of them than training on the true reward "
        f"in {honest_too} of these; of {len(lies)} settings it keeps less than 90 % of the true return of the agent trained "
        f"on the true reward in {len(poor)}{_by_agent(poor)}. With so few seeds these shares are rough: see the "
        f"intervals. All settings of a robot together, uard-0.1 keeps: {'; '.join(together) or 'not all were run'}."
    )
    tame = [
        f"{r['robot']} {r['region']} {r['agent']}"
        for r in p.rows(HACKING, mitigation="raw")
        if (honest := _rival(p, r, "true reward")) is not None
        and p.of(r, "true_return").ci95[1] >= p.of(honest, "true_return").ci95[0]
    ]
    if tame:
        out.append(
            f"MuJoCo: in {'; '.join(tame)} the raw agent's true return is not clearly below that of the agent trained on "
            "the true reward, so there is little to prevent there, and its rows prove little."
        )
    plain = [(r, shares(p, r)[1]) for r in ours if r["region"] == "none"]
    dear = [f"{_name(r)} {100 * (1 - x):.0f} %" for r, x in plain if x is not None and x < 1 - COST]
    if plain:
        out.append(
            f"MuJoCo without a lie: uard-0.1 costs more than 5 % of the true return in {len(dear)} of {len(plain)} "
            f"settings{_listed(dear)}."
        )
    parts = [f"{r['learns_from']} {summary(p.per_seed(r, 'true_return'))}" for r in p.rows(CAUTION)]
    if parts:
        out.append(
            f"MuJoCo without a lie, which part of listening costs (Hopper, PPO, true return): {'; '.join(parts)}."
        )
    return out


def _steps_inside(p: Published, r: Row) -> str:
    rows = (r, _rival(p, r, "raw"), _rival(p, r, "true reward"))
    own, raw, honest = ("?" if x is None else number(p.of(x, "hacks").mean) for x in rows)
    return f"{own} steps of {raw}; true reward {honest}"


def _of_noise(p: Published) -> list[str]:
    missed = []
    for r in p.rows(NOISE, mitigation="uard-0.1"):
        raw, honest = (
            _found(p, HACKING, robot="hopper", region="vibration", agent=r["agent"], mitigation=m) for m in REFERENCES
        )
        removed, kept = _removed(p, r, raw), _kept(p, r, honest)
        if r["noise"] and ((removed is not None and removed < REMOVED) or (kept is not None and kept < KEPT)):
            hacks, true = (summary(p.per_seed(r, m)) for m in ("hacks", "true_return"))
            missed.append(f"{r['agent']} at {100 * r['noise']:.0f} %: {hacks} hack steps, true return {true}")
    better = []
    for r in p.rows(NOISE, mitigation="uard-0.1"):
        own = p.of(r, "true_return").mean
        rivals = [
            x for x in p.rows(NOISE, agent=r["agent"], noise=r["noise"]) if x["mitigation"] not in ("uard-0.1", "raw")
        ]
        if over := [x for x in rivals if p.of(x, "true_return").mean > own]:
            names = ", ".join(f"{x['mitigation']} {summary(p.per_seed(x, 'true_return'))}" for x in over)
            better.append(
                f"{r['agent']} at {100 * r['noise']:.0f} %: {names} (uard-0.1 {summary(p.per_seed(r, 'true_return'))})"
            )
    out = []
    if missed:
        out.append(
            f"MuJoCo, Hopper, vibration, noisy raters ({_steps(p, NOISE)}): uard-0.1 removes less than 93.6 % of the hacks or "
            f"keeps less than 90 % of the honest agent's true return: {'; '.join(missed)}."
        )
    if better:
        out.append(f"MuJoCo, Hopper, vibration: others who listen have a higher true return: {'; '.join(better)}.")
    return out


def _listed(names: list[str]) -> str:
    return f" ({'; '.join(names)})" if names else ""


def _by_agent(found: list[tuple[Row, str]]) -> str:
    groups: dict[str, list[str]] = {}
    for r, text in found:
        groups.setdefault(r["agent"], []).append(f"{r['robot']} {r['region']} {r['panel']} {text}")
    return _listed([f"{agent}: {', '.join(items)}" for agent, items in groups.items()])


def _name(r: Row) -> str:
    return f"{r['robot']} {r['region']} {r['agent']} {r['panel']}"


def drawn(p: Published) -> list[tuple[str, str, str]]:
    """Return (title, what to see, image) of each figure for which there are results."""
    made = []
    for robot in dict.fromkeys(robot for robot, _ in _settings(p)):
        note = "One dot per seed, a bar at the mean. A mitigation works if hacks fall and the true return does not."
        title = f"G6, G7 · {robot}: steps in the region that lies, and what they were worth"
        made.append((title, note, _dots(p, robot)))
    traced = p.rows(DISTORTION)
    if len(traced) == len(p.studies[DISTORTION].rows):
        note = "The first seed. Shaded: the windows in which the observed reward is inflated."
        rivals = {name: (_traced(p, name)[1], "#c1272d") for name in ("edac", "sunrise")}
        ours = _traced(p, "uard-0.1")
        figure = figures.adjusted_reward(rivals, ours[1], "ensemble-sac + uard-0.1", examine.WINDOWS)
        made.append(("G14, G15 · confidence-adjusted reward under distortion, Hopper", note, figure))
        note = "Left: what each would learn from; right: lambda_t of uard-0.1, which should rise in the windows."
        made.append(
            ("G12 · a hacking region, and lambda_t, Hopper", note, figures.hacking_region(ours, examine.WINDOWS))
        )
        note = (
            "The reward of a random action's step is raised by epsilon and then filtered. Left: the mean advantage of the "
            "agent's own action over it, on the learned critics; right: how often its sign is kept. Mean over seeds."
        )
        made.append(("G13 · sign preservation on learned critics, Hopper", note, _signs(p)))
    return [(title, note, data_uri(figure)) for title, note, figure in made]


def _traced(p: Published, agent: str) -> np.ndarray:
    (r, *_) = p.rows(DISTORTION, agent=agent)
    return p.derived(r, "trace")


def _signs(p: Published) -> Figure:
    figure, axes = axes_of(2, 6.2, 3.8)
    for agent, style in (("uard-0.1", "-"), ("uard-0.1 (ppo)", "--")):
        (r, *_) = p.rows(DISTORTION, agent=agent)
        mean = p.derived(r, "perturbed").reshape(-1, len(examine.EPSILONS), len(examine.PERTURBED)).mean(0)
        for filtered, colour in ((True, COLOURS["uard-0.1"]), (False, "#c1272d")):
            label = f"{'ensemble-sac' if agent == 'uard-0.1' else 'ppo'}, {'filtered' if filtered else 'raw reward'}"
            for axis, column in zip(axes, (0, 2), strict=True):
                axis.plot(examine.EPSILONS, mean[:, column + (not filtered)], color=colour, ls=style, label=label)
    axes[0].axhline(0.0, color="k", lw=0.8)
    for axis, label in zip(axes, ("advantage", "share of signs kept"), strict=True):
        axis.set(xlabel="epsilon", ylabel=label)
    axes[0].legend(fontsize=8)
    return figure


def film() -> list[tuple[str, str, str]]:
    """Return (title, what to see, image) of the packaged film strips, if there are any."""
    facts = packaged_json("hopper-frames.json")
    if facts is None:
        return []
    shown = [
        f"{r['label']}: {r['true_return']:.0f} in {r['length']} steps, {r['hacks']} in the region"
        for r in facts["rows"]
    ]
    note = (
        f"From the top, each an episode whole, its true return and its length: {'; '.join(shown)}. 42 and 110 are the "
        f"paper's thresholds: a robot that falls over. One seed. Made by {facts['command']}, version {facts['version']}."
    )
    picture = (resources.files("uard.replication") / "results" / "hopper-frames.webp").read_bytes()
    image = "data:image/webp;base64," + base64.b64encode(picture).decode()
    return [("H4 · what returns of 42 and 110 look like, a hacker, and uard-0.1", note, image)]


def _dots(p: Published, robot: str) -> Figure:
    there = p.rows(HACKING, robot=robot)
    settings = list(dict.fromkeys((r["agent"], r["region"]) for r in there if r["region"] != "none"))
    figure, axes = axes_of(2, 6.2, 1.2 + 0.7 * len(settings))
    for axis, metric, label in zip(
        axes, ("hacks", "true_return"), ("steps in the region per episode", "true return"), strict=True
    ):
        names = []
        for i, (agent, region) in enumerate(settings):
            names.append(f"{agent}\n{region}")
            rows = p.rows(HACKING, robot=robot, region=region, agent=agent)
            for j, r in enumerate(rows):
                values, y = p.per_seed(r, metric), i + 0.8 * ((j + 0.5) / len(rows) - 0.5)
                hollow = r["panel"] == "appendix"
                colour = COLOURS[r["mitigation"]]
                axis.plot(values, np.full(len(values), y), "o", ms=4, color=colour, mfc="none" if hollow else colour)
                axis.plot([values.mean()] * 2, [y - 0.05, y + 0.05], color=colour, lw=2)
        axis.set(xlabel=label, yticks=range(len(names)), yticklabels=names)
        axis.invert_yaxis()
    for name, colour in COLOURS.items():
        axes[0].plot([], [], "o", color=colour, label=name)
    axes[0].plot([], [], "o", color="#777777", mfc="none", label="appendix panel")
    axes[0].legend(fontsize=8, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=5)  # above: it hides no dot
    return figure
