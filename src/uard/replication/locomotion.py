"""Tables, figures and findings of Hopper and Walker2d (G6, G7, G10-G15; H4, H11-H16), from the published results."""

from __future__ import annotations

import base64
from collections.abc import Iterable
from importlib import resources
from typing import Any

import numpy as np

from uard.lab import statistics
from uard.lab.study import Row
from uard.lab.trainers import examine
from uard.lab.views.figures import Chart, Picture, made_by
from uard.lab.views.losses import Kind, Loss, of_family
from uard.lab.views.palette import DASHED, SOLID, look
from uard.lab.views.published import Published, packaged_json
from uard.lab.views.tables import Cell, Number, Table, bounds, full, number
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
        cells = (p.of(r, m) for m in METRICS)
        share = _shares(p, r)
        where = f"{r['robot']}, {r['region']}" if r["region"] != "none" else f"{r['robot']}, no lie"
        best = (statistics.summarise(x) for x in p.derived(r, "deterministic").T)
        rows.append((where, r["agent"], r["mitigation"], r["panel"], *cells, *share, *best))
    return Table(
        f"Hopper and Walker2d with a reward that lies (G6, G7), {_steps(p, HACKING)}, 15 % of steps rated",
        (
            "task", "agent", "learns from", "panel", *HEADS, "hacks removed, %", "true return kept, %",
            "deterministic: steps in the region", "deterministic: true return",
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


def _shares(p: Published, r: Row) -> tuple[Cell, Cell]:
    if r["mitigation"] in REFERENCES:
        return None, None
    removed, kept = (None if x is None else Number(100 * x) for x in shares(p, r))
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
                shares = (statistics.summarise(100 * x) for x in found)
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
        (r["agent"], r["mitigation"], f"{100 * r['noise']:.0f} %", *(p.of(r, m) for m in METRICS))
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
            *(p.of(r, m) for m in (*METRICS, "episode_length")),
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
    def cell(columns: dict[str, np.ndarray], name: str) -> Cell:
        values = columns[name] if name == "standing" else columns[name][columns["standing"] > 0]
        return statistics.summarise(values) if len(values) else None

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
        (r["region"], f"{r['bonus']:g}", r["mitigation"], r["panel"], *(p.of(r, m) for m in METRICS))
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
    rows = [(r["region"], r["mitigation"], r["panel"], *(p.of(r, m) for m in METRICS)) for r in p.rows(LEGITIMATE)]
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
        best = (statistics.summarise(x) for x in p.derived(r, "deterministic").T[1:])
        share = None if kept is None else f"{100 * kept:.0f} %"
        rows.append((r["learns_from"], p.of(r, "true_return"), share, *best))
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
        (r["agent"], r["region"], r["variant"], r["panel"], *(p.of(r, m) for m in METRICS)) for r in p.rows(ABLATION)
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
        best = (statistics.summarise(x) for x in p.derived(r, "deterministic").T)
        cells = (p.of(r, m) for m in ("hacks", "true_return"))
        rows.append((r["region"], r["panel"], r["query"], *cells, *best))
    return Table(
        f"Which steps are rated: Hopper, PPO with uard-0.1, {_steps(p, RATING)}, 15 % of steps",
        (
            "region", "panel", "rated steps", "steps in the region per episode", "true return",
            "deterministic: steps in the region", "deterministic: true return",
        ),
        tuple(rows),
        3,
        "Random, or half of them where the model of the ratings knows least (doubtful).",
    )  # fmt: skip


def _distortion(p: Published) -> Table:
    rows = []
    for r in p.rows(DISTORTION):
        columns = np.column_stack([p.derived(r, "reaction"), p.derived(r, "warning")]).T
        rows.append((r["agent"], r["critics"], *(statistics.summarise(c) for c in columns)))
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
        low, high = (f"{x:,.0f}".replace(",", " ") for x in r["range"])
        share = f"{100 * r['share_of_matrix_rate']:.0f} %" if "share_of_matrix_rate" in r else None
        times = r["rate"] / first.setdefault(r["what"], r["rate"])
        rows.append((r["what"], r["who"], f"{r['rate']:,.0f}".replace(",", " "), f"{low} to {high}", times, share))
    return Table(
        "Speed in MuJoCo, side by side",
        ("what", "who", "rate per second", "range", "times the first", "of the matrix rate"),
        tuple(rows),
        2,
        f"Made by {data['command']} on {data['machine']}; rates are per second. Machines differ: where products of "
        "matrices are slower, all SACs are nearer to each other.",
    )


def losses(p: Published) -> list[Loss]:
    """Say where ``uard-0.1`` misses what is asked of it in MuJoCo, found by rule; none of it is of today's ``uard``."""
    return [
        *_of_returns(p),
        *_of_hacks(p),
        *_of_tame(p),
        *_of_nothing(p),
        *_of_twins(p),
        *_of_noise(p),
        *_of_distortion(p),
    ]


def _loss(kind: Kind, what: str, where: str, **fields: Any) -> Loss:
    return Loss(kind, "robots, uard-0.1", what, where, **fields)


def _of_agent(p: Published, **labels: Any) -> dict[str, list[Row]]:
    """Return the rows of ``uard-0.1`` by agent."""
    groups: dict[str, list[Row]] = {}
    for r in p.rows(HACKING, mitigation="uard-0.1", **labels):
        groups.setdefault(r["agent"], []).append(r)
    return groups


def _lying(rows: list[Row]) -> list[Row]:
    return [r for r in rows if r["region"] != "none"]


def _of_returns(p: Published) -> list[Loss]:
    out = []
    for agent, rows in _of_agent(p).items():
        kept = [(share, r) for r in _lying(rows) if (share := shares(p, r)[1]) is not None]
        poor = [share for share, _ in kept if share < KEPT]
        if poor:
            _, r = min(kept, key=lambda k: k[0])
            what = (
                f"more than {100 * (1 - KEPT):.0f} % of the true return is lost in {len(poor)} of {len(kept)} settings"
            )
            honest = _rival(p, r, "true reward")
            theirs = None if honest is None else p.of(honest, "true_return")
            numbers = {"against": "true reward", "ours": p.of(r, "true_return"), "theirs": theirs}
            out.append(_loss("fails", what, f"{agent}; worst: {_place(r)}", **numbers))
    return out


def _of_hacks(p: Published) -> list[Loss]:
    out = []
    for agent, rows in _of_agent(p).items():
        removed = [(share, r) for r in _lying(rows) if (share := shares(p, r)[0]) is not None]
        leaks = [r for share, r in removed if share < REMOVED]
        if leaks:
            _, r = min(removed, key=lambda k: k[0])
            honest = _rival(p, r, "true reward")
            left = 100 * (1 - REMOVED)
            what = (
                f"more than {left:.1f} % of the raw agent's hacks are left in {len(leaks)} of {len(removed)} settings"
            )
            why = f"in {_as_honest(p, leaks)} of these no more than by training on the true reward"
            theirs = None if honest is None else p.of(honest, "hacks")
            numbers = {"against": "true reward", "ours": p.of(r, "hacks"), "theirs": theirs, "metric": "hacks"}
            out.append(_loss("fails", what, f"{agent}; worst: {_place(r)}", why=why, **numbers))
    return out


def _as_honest(p: Published, rows: list[Row]) -> int:
    rivals = ((r, _rival(p, r, "true reward")) for r in rows)
    return sum(h is not None and p.of(r, "hacks").mean <= p.of(h, "hacks").mean for r, h in rivals)


def _of_tame(p: Published) -> list[Loss]:
    """Where the lie does no harm: what a filter does there proves nothing."""
    pairs = [(r, x) for r in p.rows(HACKING, mitigation="raw") if (x := _rival(p, r, "true reward")) is not None]
    family = p.compare(pairs, "true_return")
    return [
        _loss(
            "no better",
            "the lie does no harm that can be told: nothing is proved here",
            f"{r['robot']} {r['region']}, {r['agent']}",
            against="raw",
            p=of_family(family, i)[0],
            of=family.compared,
            note=f"raw {_ends(p.of(r, 'true_return'))}, true reward {_ends(p.of(honest, 'true_return'))}",
        )
        for i, (r, honest) in enumerate(pairs)
        if family.tests[i] and not family.below(i)
    ]


def _ends(s: statistics.Summary) -> str:
    return f"{number(s.mean)}{bounds(s.ci95)}"


def _of_nothing(p: Published) -> list[Loss]:
    """What is lost where nothing lies."""
    out = []
    for agent, rows in _of_agent(p, region="none").items():
        for r in rows:
            raw, share = _rival(p, r, "raw"), shares(p, r)[1]
            if raw is not None and share is not None and 1 - share > COST:
                what = f"{100 * (1 - share):.0f} % of the raw agent's true return is lost, and nothing lies"
                numbers = {"against": "raw", "ours": p.of(r, "true_return"), "theirs": p.of(raw, "true_return")}
                out.append(_loss("costs", what, f"{r['robot']}, {agent}", **numbers))
    return out


def _of_twins(p: Published) -> list[Loss]:
    out = []
    for r in p.rows(LEGITIMATE, mitigation="uard-0.1"):
        raw = _found(p, LEGITIMATE, mitigation="raw", region=r["region"])
        kept = _kept(p, r, raw)
        if raw is not None and kept is not None and kept < 1 - COST:
            what = f"the bonus is real, and {100 * (1 - kept):.0f} % of the true return is lost"
            numbers = {"against": "raw", "ours": p.of(r, "true_return"), "theirs": p.of(raw, "true_return")}
            out.append(_loss("costs", what, f"hopper {r['region']}, PPO, {r['panel']} panel", **numbers))
    return out


def _of_noise(p: Published) -> list[Loss]:
    out = []
    for r in p.rows(NOISE, mitigation="uard-0.1"):
        raw, honest = (
            _found(p, HACKING, robot="hopper", region="vibration", agent=r["agent"], mitigation=m) for m in REFERENCES
        )
        removed, kept = _removed(p, r, raw), _kept(p, r, honest)
        where = f"hopper, {r['agent']}, raters' noise {100 * r['noise']:.0f} %"
        own = p.of(r, "true_return")
        if raw is not None and r["noise"] and removed is not None and removed < REMOVED:
            what = f"{100 * (1 - removed):.1f} % of the raw agent's hacks are left"
            theirs = None if honest is None else p.of(honest, "hacks")
            numbers = {"against": "true reward", "ours": p.of(r, "hacks"), "theirs": theirs, "metric": "hacks"}
            out.append(_loss("fails", what, where, **numbers))
        if honest is not None and r["noise"] and kept is not None and kept < KEPT:
            what = f"{100 * (1 - kept):.0f} % of the honest agent's true return is lost"
            numbers = {"against": "true reward", "ours": own, "theirs": p.of(honest, "true_return")}
            out.append(_loss("fails", what, where, **numbers))
        for x in p.rows(NOISE, agent=r["agent"], noise=r["noise"]):
            if x["mitigation"] not in ("uard-0.1", "raw") and p.of(x, "true_return").mean > own.mean:
                name = x["mitigation"]
                numbers = {"against": name, "ours": own, "theirs": p.of(x, "true_return")}
                out.append(_loss("no better", f"{name} has a higher mean", where, **numbers))
    return out


def _of_distortion(p: Published) -> list[Loss]:
    rows = {r["critics"]: r for r in p.rows(DISTORTION, agent="uard-0.1")}
    if len(rows) < 2:
        return []
    shared, full_ones = (list(p.derived(rows[k], "warning").T) for k in ("5, shared trunk", "5, full"))
    return [
        _loss(
            "no better",
            "critics on one trunk warn less than full ones",
            what,
            against="5 full critics",
            ours=statistics.summarise(a),
            theirs=statistics.summarise(b),
            metric="AUROC of sigma_m",
            note="one run" if len(a) == 1 else "",
        )
        for what, a, b in zip(("states thrown off", "wrong values"), shared, full_ones, strict=True)
        if b.mean() - a.mean() > AS_GOOD
    ]


def _place(r: Row) -> str:
    return f"{r['robot']} {r['region']}, {r['panel']} panel"


def drawn(p: Published) -> list[Picture]:
    """Return each picture for which there are results."""
    made = [_dots(p, robot) for robot in dict.fromkeys(robot for robot, _ in _settings(p))]
    made += _over_training(p)
    traced = p.rows(DISTORTION)
    if len(traced) == len(p.studies[DISTORTION].rows):
        seed = "The first seed. Shaded: the windows in which the observed reward is inflated."
        rivals = {name: _traced(p, name)[1] for name in ("edac", "sunrise")}
        ours = _traced(p, "uard-0.1")
        made.append(
            figures.adjusted_reward(rivals, ours[1], "uard-0.1", examine.WINDOWS).picture(
                "g14-g15-hopper",
                "G14, G15 · confidence-adjusted reward under distortion, Hopper",
                f"See which line jumps in the shaded windows: it believes the inflated reward. {seed}",
                _command(p, DISTORTION),
            )
        )
        made.append(
            figures.hacking_region(ours, examine.WINDOWS).picture(
                "g12-hopper",
                "G12 · a hacking region, and lambda_t, Hopper",
                f"See whether lambda_t (below) rises in the windows, as it should, and our reward (above) stays. {seed}",
                _command(p, DISTORTION),
            )
        )
        made.append(_signs(p))
    return made


def _command(p: Published, study: str) -> str:
    """Return what makes the results of a study."""
    seeds = max(len(p.seeds_of(r)) for r in p.rows(study))
    return made_by(p.sources, study, f"uard reproduce {study} --seeds {seeds}")


FIGURES = {
    "hopper": ("G6", ("target",)),
    "walker2d": ("G7", ("UARD", "baselines")),
}  # and what the paper prints of them


def _over_training(p: Published) -> list[Picture]:
    made = []
    for robot, (name, what) in FIGURES.items():
        rows = drifting(p, robot=robot)
        curves = {r["mitigation"]: p.derived(r, "learning") for r in rows}
        if curves:
            printed = {label: paper.FIGURES[name].number(label) for label in what}
            note = (
                "See whether the observed return rises while the true one falls: that would be the drift that the paper "
                f"shows. PPO, vibration, main panel, {_budget(p, drifting(p))}. Lines are means over seeds of the episodes "
                "that ended in each twentieth of the training, bands their 95 % intervals. Dotted, of the paper: "
                + ", ".join(f"{label} {value:g}" for label, value in printed.items())
                + "."
            )
            chart = figures.over_training(curves, rows[0].cell.steps or 0, list(printed.values()))
            title = f"{name} · {robot} over its training"
            made.append(chart.picture(f"{name.lower()}-{robot}-training", title, note, _command(p, DRIFT)))
    rows = drifting(p, robot="hopper")
    for i, size in reversed([*enumerate(examine.KICKS)][1:] if rows else []):
        walks = {r["mitigation"]: p.derived(r, "kicked")[:, i] for r in rows}
        note = (
            f"See both sigmas after the dotted line: {size:g} m/s from behind after step {examine.KICKED_AT} of an episode of "
            "the trained agent. Lines are means over the seeds of which a copy still stands, bands their 95 % intervals; a "
            "line ends where fewer than two are left. Raw agents ask no raters."
        )
        title = f"G10 · sigma_m and sigma_h along an episode with a kick of {size:g} m/s, Hopper"
        id = f"g10-kick-{size:g}".replace(".", "-")
        made.append(figures.kicked(walks).picture(id, title, note, _command(p, DRIFT)))
    return made


def _traced(p: Published, agent: str) -> np.ndarray:
    (r, *_) = p.rows(DISTORTION, agent=agent)
    return p.derived(r, "trace")


def _signs(p: Published) -> Picture:
    chart = Chart(
        ["Advantage of the agent's own action", "How often its sign is kept"],
        "perturbation epsilon, reward units",
        ["advantage", "share of signs kept"],
    )
    for agent, dash in (("uard-0.1", SOLID), ("uard-0.1 (ppo)", DASHED)):
        (r, *_) = p.rows(DISTORTION, agent=agent)
        mean = p.derived(r, "perturbed").reshape(-1, len(examine.EPSILONS), len(examine.PERTURBED)).mean(0)
        who = "ensemble-sac" if agent == "uard-0.1" else "ppo"
        for filtered, how in ((True, look("uard-0.1")), (False, look("raw"))):
            label = f"{who}, {'filtered' if filtered else 'raw reward'}"
            for i, column in enumerate((0, 2)):
                y = mean[:, column + (not filtered)]
                chart.line(i, examine.EPSILONS, y, label, look_of=how._replace(dash=dash))
    chart.reference(0, 0.0, "")
    note = (
        "See whether the filtered lines stay above the raw ones: then the filter protects the choice. The reward of a random "
        "action's step is raised by epsilon and then filtered; the advantage is of the agent's own action over it, on the "
        "learned critics. Lines are means over seeds."
    )
    title = "G13 · sign preservation on learned critics, Hopper"
    return chart.picture("g13-hopper", title, note, _command(p, DISTORTION))


def film() -> list[Picture]:
    """Return the packaged film strips, if there are any."""
    facts = packaged_json("hopper-frames.json")
    if facts is None:
        return []
    shown = [
        f"{r['label']}: {r['true_return']:.0f} in {r['length']} steps, {r['hacks']} in the region"
        for r in facts["rows"]
    ]
    note = (
        "See who walks, who falls and who is paid for standing. From the top, each an episode whole, its true return and its length: "
        f"{'; '.join(shown)}. 42 and 110 are the paper's thresholds: a robot that falls over. One seed, version "
        f"{facts['version']}."
    )
    strip = (resources.files("uard.replication") / "results" / "hopper-frames.webp").read_bytes()
    image = "data:image/webp;base64," + base64.b64encode(strip).decode()
    columns = ("label", "true return", "steps", "steps in the region")
    rows = tuple((r["label"], r["true_return"], r["length"], r["hacks"]) for r in facts["rows"])
    title = "H4 · what returns of 42 and 110 look like, a hacker, and uard-0.1"
    return [Picture("film", title, note, image, columns, rows, facts["command"])]


def _dots(p: Published, robot: str) -> Picture:
    there = p.rows(HACKING, robot=robot)
    settings = list(dict.fromkeys((r["agent"], r["region"]) for r in there if r["region"] != "none"))
    chart = Chart(
        ["Steps in the region that lies", "What they were worth"],
        ["steps in the region per episode", "true return per episode"],
        "",
        height=1.0 + 0.62 * len(settings),
    )
    for panel, metric in enumerate(("hacks", "true_return")):
        axis = chart.axes[panel]
        for i, (agent, region) in enumerate(settings):
            rows = p.rows(HACKING, robot=robot, region=region, agent=agent)
            for j, r in enumerate(rows):
                values, y = p.per_seed(r, metric), i + 0.8 * ((j + 0.5) / len(rows) - 0.5)
                name, hollow = r["mitigation"], r["panel"] == "appendix"
                series = f"{agent}, {region}, {name}, {r['panel']} panel"
                chart.dots(panel, values, np.full(len(values), y), series, look(name), hollow)
                axis.plot([values.mean()] * 2, [y - 0.05, y + 0.05], color=look(name).light, lw=2)
        axis.set(ylim=(len(settings) - 0.5, -0.5))
        named = {float(i): f"{agent}\n{region}" if not panel else "" for i, (agent, region) in enumerate(settings)}
        chart.plain(panel, named, "y")
    chart.key(
        {name: look(name)._replace(width=5.0, dash="-") for name in ("true reward", "raw", "uard-paper", "uard-0.1")}
    )
    note = (
        "See that a mitigation works if its dots are at the left in the left panel and not farther left than those of the true "
        "reward in the right one. One dot per seed, a bar at their mean; hollow: appendix panel."
    )
    title = f"G6, G7 · {robot}: steps in the region that lies, and what they were worth"
    return chart.picture(f"g6-g7-{robot}", title, note, _command(p, HACKING))
