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
from uard.replication import figures, paper
from uard.replication.studies import derive

HACKING, NOISE, KICK = "mujoco-standard-hacking", "mujoco-standard-noise", "mujoco-standard-kick"
DISTORTION, RATING = "mujoco-standard-distortion", "mujoco-standard-rating"
BONUSES, ABLATION = "mujoco-standard-bonuses", "mujoco-standard-ablation"
DRIFT = "mujoco-standard-drift"
LEGITIMATE, CAUTION = "mujoco-standard-legitimate", "mujoco-standard-caution"
WINDOWS = {"before": (25, 50), "kick": (50, 60), "later": (130, 150)}  # steps of a walk that is kicked after step 50
AS_GOOD = 0.03  # by how much the AUROC of a cheaper sigma_m may be lower
REFERENCES = ("raw", "true reward")
REMOVED, KEPT, COST = 0.936, 0.9, 0.05  # the paper's best reduction (J16); what is asked of a filter beside it
METRICS = ("hacks", "true_return", "observed_return")
HEADS = ("steps in the region per episode", "true return", "observed return")  # of METRICS
COLOURS = {"true reward": "#444444", "raw": "#c1272d", "uard-paper": "#e08214", "uard-0.1": "#2c6fbb"}


def summary(values: np.ndarray) -> str:
    """Return one number per seed as text: mean, deviation and interval; of one seed, that number alone."""
    return full(statistics.summarise(values))


def tables(p: Published) -> list[Table]:
    """Return all tables for which there are results."""
    makers = (
        _hacking,
        _pooled,
        _noise,
        _kick,
        _around_kick,
        _bonuses,
        _legitimate,
        _caution,
        _ablation,
        _rating,
        _distortion,
    )
    return [t for t in (*(make(p) for make in makers), _speed()) if t.rows]


def _steps(p: Published, study: str) -> str:
    return _budget(p, p.rows(study))


def _budget(p: Published, rows: list[Row]) -> str:
    """Say for how many steps and seeds rows were trained."""

    def each(numbers: Iterable[int]) -> str:
        return " or ".join(f"{n:,}" for n in sorted(set(numbers)))

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
    lucky run decides less. Only seeds that all rows have are compared; None if a row is missing, or there is no such seed.
    """
    groups = [
        [r for r in p.rows(HACKING, robot=robot, agent=agent, mitigation=m) if r["region"] != "none"]
        for m in (mitigation, *REFERENCES)
    ]
    shared = sorted(set.intersection(*(set(p.seeds_of(r)) for g in groups for r in g))) if all(groups) else []
    if [len(g) for g in groups] != [4, 2, 2] or not shared:
        return None

    def of(r: Row, metric: str) -> np.ndarray:
        return p.per_seed(r, metric)[[p.seeds_of(r).index(seed) for seed in shared]]

    ours, raw, honest = (np.array([[of(r, m) for m in ("hacks", "true_return")] for r in g]).mean(0) for g in groups)
    return 1.0 - ours[0] / raw[0], ours[1] / honest[1]


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


def drifting(p: Published, **labels: Any) -> list[Row]:
    """Return the rows of the study of drift; its cells may be published for another study, without their curves."""
    return [r for r in p.rows(DRIFT, **labels) if p.has(r, "kicked")]


def around_kick(p: Published, r: Row) -> dict[tuple[float, str], dict[str, np.ndarray]]:
    """Return what is found around a kick, by its size and a window: ``examine.KICKED`` by name, each (seeds,).

    Standing is a share of the copies that stood when they were kicked; seeds in which none did are left out. Where it is
    0 the other columns say nothing.
    """
    found = p.derived(r, "kicked")
    stood = found[:, 0, examine.KICKED_AT // derive.EVERY, 0]  # of every kick alike
    found, stood = found[stood > 0], stood[stood > 0]
    out = {}
    for i, size in enumerate(examine.KICKS):
        for window, (first, end) in WINDOWS.items():
            groups = found[:, i, first // derive.EVERY : end // derive.EVERY]
            standing = groups[..., :1]
            means = (groups * standing).sum(1) / np.maximum(standing.sum(1), 1e-9)
            columns = dict(zip(examine.KICKED, means.T, strict=True))
            out[size, window] = columns | {"standing": standing.mean((1, 2)) / stood}
    return out


_SHOWN = (("before", examine.KICKS[-1]), *((w, k) for w in ("kick", "later") for k in examine.KICKS))


def _around_kick(p: Published) -> Table:
    def cell(columns: dict[str, np.ndarray], name: str) -> str:
        values = columns[name] if name == "standing" else columns[name][columns["standing"] > 0]
        return summary(values) if len(values) else "–"

    rows = []
    for r in drifting(p):
        found = around_kick(p, r)
        if len(found[0.0, "before"]["standing"]):
            for window, size in _SHOWN:
                kicked = "–" if window == "before" else f"{size:g}"
                cells = (cell(found[size, window], name) for name in examine.KICKED)
                rows.append((r["robot"], r["mitigation"], window, kicked, *cells))
    return Table(
        f"Along an episode with a kick (G10, L1985): the forward velocity is raised once, PPO, {_budget(p, drifting(p))}",
        (
            "robot", "learned from", "when", "kick, m/s", "standing", "sigma_m", "sigma_h", "weight", "observed reward",
            "learned", "true",
        ),
        tuple(rows),
        4,
        "Trained agents, 16 copies of each seed, most likely actions, kicked after step 50. Before: steps 25 to 49; kick: 50 "
        "to 59; later: 130 to 149. Standing: of the copies that stood when kicked. All else: per step, mean over the "
        "copies that still stand, so that what is said of later is said of those that did not fall. Raw agents ask nobody.",
    )  # fmt: skip


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
    """Say where ``uard-0.1`` misses what is asked of it in MuJoCo, found by rule: a short line each, what it costs first."""
    found = (
        _of_returns(p) + _of_hacks(p) + _of_tame(p) + _of_nothing(p) + _of_twins(p) + _of_noise(p) + _of_distortion(p)
    )
    return [f"MuJoCo, {line}." for line in found]


def _of_agent(p: Published, **labels: Any) -> list[tuple[str, list[Row]]]:
    """Return the rows of ``uard-0.1`` by agent; the name of one that was run once says so."""
    groups: dict[str, list[Row]] = {}
    for r in p.rows(HACKING, mitigation="uard-0.1", **labels):
        groups.setdefault(r["agent"], []).append(r)
    once = " (one run each)"
    return [(a + once * all(len(p.seeds_of(r)) == 1 for r in rows), rows) for a, rows in groups.items()]


def _lying(rows: list[Row]) -> list[Row]:
    return [r for r in rows if r["region"] != "none"]


def _of_returns(p: Published) -> list[str]:
    out = []
    for agent, rows in _of_agent(p):
        kept = [(share, r) for r in _lying(rows) if (share := shares(p, r)[1]) is not None]
        poor = [share for share, _ in kept if share < KEPT]
        if poor:
            worst, r = min(kept, key=lambda k: k[0])
            out.append(
                f"{agent}: {100 * (1 - worst):.0f} % of the honest agent's true return is lost at "
                f"worst ({_place(r)}), more than {100 * (1 - KEPT):.0f} % in {len(poor)} of {len(kept)} settings"
            )
    return out


def _of_hacks(p: Published) -> list[str]:
    out = []
    for agent, rows in _of_agent(p):
        removed = [(share, r) for r in _lying(rows) if (share := shares(p, r)[0]) is not None]
        leaks = [r for share, r in removed if share < REMOVED]
        if leaks:
            worst, r = min(removed, key=lambda k: k[0])
            out.append(
                f"{agent}: {100 * (1 - worst):.1f} % of the raw agent's hacks are left at worst ({_place(r)}: "
                f"{_steps_inside(p, r)}), more than {100 * (1 - REMOVED):.1f} % in {len(leaks)} of {len(removed)} settings, "
                f"and no more than by training on the true reward in {_as_honest(p, leaks)} of these"
            )
    return out


def _as_honest(p: Published, rows: list[Row]) -> int:
    rivals = ((r, _rival(p, r, "true reward")) for r in rows)
    return sum(h is not None and p.of(r, "hacks").mean <= p.of(h, "hacks").mean for r, h in rivals)


def _of_tame(p: Published) -> list[str]:
    pairs = [(r, x) for r in p.rows(HACKING, mitigation="raw") if (x := _rival(p, r, "true reward")) is not None]
    family = p.compare(pairs, "true_return")
    tame = [
        f"{r['robot']} {r['region']} {r['agent']}"
        for i, (r, _) in enumerate(pairs)
        if family.tests[i] and not family.below(i)
    ]
    if not tame:
        return []
    return [f"no loss, but no proof: the raw agent's true return is no worse than the honest agent's{_listed(tame)}"]


def _of_nothing(p: Published) -> list[str]:
    """What is lost where nothing lies."""
    out = []
    for agent, rows in _of_agent(p, region="none"):
        lost = [(100 * (1 - share), r["robot"]) for r in rows if (share := shares(p, r)[1]) is not None]
        dear = [f"{share:.0f} % ({robot})" for share, robot in lost if share > 100 * COST]
        if dear:
            out.append(f"nothing lies, {agent}: {' and '.join(dear)} of the raw agent's true return is lost")
    return out


def _of_twins(p: Published) -> list[str]:
    out = []
    for r in p.rows(LEGITIMATE, mitigation="uard-0.1"):
        kept = _kept(p, r, _found(p, LEGITIMATE, mitigation="raw", region=r["region"]))
        if kept is not None and kept < 1 - COST:
            where = f"{r['region']}, {r['panel']} panel"
            out.append(f"the bonus is real, Hopper, PPO: {100 * (1 - kept):.0f} % of the true return is lost ({where})")
    return out


def _of_noise(p: Published) -> list[str]:
    out = []
    for r in p.rows(NOISE, mitigation="uard-0.1"):
        raw, honest = (
            _found(p, HACKING, robot="hopper", region="vibration", agent=r["agent"], mitigation=m) for m in REFERENCES
        )
        removed, kept = _removed(p, r, raw), _kept(p, r, honest)
        setting = f"raters' noise {100 * r['noise']:.0f} %, Hopper, {r['agent']}"
        own = summary(p.per_seed(r, "true_return"))
        if r["noise"] and removed is not None and removed < REMOVED:
            hacks = summary(p.per_seed(r, "hacks"))
            out.append(f"{setting}: {100 * (1 - removed):.1f} % of the raw agent's hacks are left, {hacks} steps")
        if r["noise"] and kept is not None and kept < KEPT:
            out.append(f"{setting}: {100 * (1 - kept):.0f} % of the honest agent's true return is lost, {own} remains")
        for x in p.rows(NOISE, agent=r["agent"], noise=r["noise"]):
            if x["mitigation"] not in ("uard-0.1", "raw") and p.of(x, "true_return").mean > p.of(r, "true_return").mean:
                theirs = summary(p.per_seed(x, "true_return"))
                out.append(f"{setting}: {x['mitigation']} has a higher true return: {theirs} against {own}")
    return out


def _of_distortion(p: Published) -> list[str]:
    rows = {r["critics"]: r for r in p.rows(DISTORTION, agent="uard-0.1")}
    if len(rows) < 2:
        return []
    shared, full_ones = (list(p.derived(rows[k], "warning").T) for k in ("5, shared trunk", "5, full"))
    return [
        f"sigma_m of five critics on one trunk warns of {what} with an AUROC of {summary(a)}, of five full ones {summary(b)}"
        for what, a, b in zip(("states thrown off", "wrong values"), shared, full_ones, strict=True)
        if b.mean() - a.mean() > AS_GOOD
    ]


def _steps_inside(p: Published, r: Row) -> str:
    rows = (r, _rival(p, r, "raw"), _rival(p, r, "true reward"))
    own, raw, honest = ("?" if x is None else number(p.of(x, "hacks").mean) for x in rows)
    return f"{own} steps of {raw}; true reward {honest}"


def _listed(names: list[str]) -> str:
    return f" ({'; '.join(names)})" if names else ""


def _place(r: Row) -> str:
    return f"{r['robot']} {r['region']}, {r['panel']} panel"


def drawn(p: Published) -> list[tuple[str, str, str]]:
    """Return (title, what to see, image) of each figure for which there are results."""
    made = []
    for robot in dict.fromkeys(robot for robot, _ in _settings(p)):
        note = "One dot per seed, a bar at the mean. A mitigation works if hacks fall and the true return does not."
        title = f"G6, G7 · {robot}: steps in the region that lies, and what they were worth"
        made.append((title, note, _dots(p, robot)))
    made += _over_training(p)
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


TARGETS = {"hopper": ("G6", "Hopper objective"), "walker2d": ("G7", "Walker2d objective")}


def _over_training(p: Published) -> list[tuple[str, str, Figure]]:
    made = []
    for robot, (name, objective) in TARGETS.items():
        rows = drifting(p, robot=robot)
        curves = {r["mitigation"]: (p.derived(r, "learning"), COLOURS[r["mitigation"]]) for r in rows}
        if curves:
            target = paper.TEXT[objective].value
            figure = figures.over_training(curves, rows[0].cell.steps or 0, target)
            note = (
                f"PPO, vibration, main panel, {_budget(p, drifting(p))}. Mean over seeds and its 95 % interval, of the episodes that "
                f"ended in each twentieth of the training. Dotted: the paper's objective of {target:g}, a fall. Drift is where "
                "the observed return rises and the true one falls."
            )
            made.append((f"{name} · {robot} over its training", note, figure))
    rows = drifting(p, robot="hopper")
    for i, size in reversed([*enumerate(examine.KICKS)][1:] if rows else []):
        walks = {r["mitigation"]: (p.derived(r, "kicked")[:, i], COLOURS[r["mitigation"]]) for r in rows}
        note = (
            f"{size:g} m/s from behind after step {examine.KICKED_AT} of an episode of the trained agent. Mean over the seeds "
            "of which a copy still stands, and its 95 % interval; a line ends where fewer than two are left. Raw agents ask "
            "no raters."
        )
        title = f"G10 · sigma_m and sigma_h along an episode with a kick of {size:g} m/s, Hopper"
        made.append((title, note, figures.kicked(walks)))
    return made


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
