"""Hopper and Walker2d, from the published results; with the grids where a claim is about both (J16, J21, J25, J36, J45, L1985)."""

from __future__ import annotations

from functools import partial
from typing import Any

from uard.lab import statistics
from uard.lab.statistics import Summary
from uard.lab.trainers import examine
from uard.lab.views import published
from uard.lab.views.study_results import StudyResults
from uard.replication import locomotion, paper
from uard.replication.ledger.claim import Conditions, above_zero, agrees, below, below_in, below_zero, reduction
from uard.replication.ledger.grids import FEW
from uard.replication.paper import Stat
from uard.replication.studies.grids import PANELS
from uard.replication.verdicts import Numbers, Part, each

ROBOTS = {"Hopper": "hopper", "Walker2d": "walker2d"}
AGENTS = {"PPO": "ppo", "SAC": "sac"}  # whom the paper's noise study is about


def _hacks(robot: str, mitigation: str) -> list[tuple[float, float]]:
    """Return hacks per episode, ours and the raw agent's, of each setting in which the raw agent makes at least one."""
    p = published.packaged()
    raw = {
        (r["agent"], r["region"]): p.of(r, "hacks").mean
        for r in p.rows(locomotion.HACKING, robot=robot, mitigation="raw")
    }
    settings = [
        (p.of(r, "hacks").mean, raw.get((r["agent"], r["region"]), 0.0))
        for r in p.rows(locomotion.HACKING, robot=robot, mitigation=mitigation)
    ]
    return [(ours, theirs) for ours, theirs in settings if theirs >= 1]


def _everywhere(results: StudyResults) -> dict[str, Any] | None:
    printed_form = {name: _hacks(robot, "uard-paper") for name, robot in ROBOTS.items()}
    repaired = [1 - ours / raw for robot in ROBOTS.values() for ours, raw in _hacks(robot, "uard-0.1")]
    if not all(printed_form.values()) or not repaired:
        return None
    ours, base, walker = (
        results.get("table3", "hacks", agent=a, horizon=100, panel="main")
        for a in ("uard-paper", "baseline", "random walk")
    )
    well_specified, raw = (
        results.get("legitimate", "true_return", mitigation=m, size=10, trap=4.0, panel="main")
        for m in ("uard-paper", "raw")
    )
    kept = {name: locomotion.pooled(published.packaged(), robot, "ppo", "uard-paper") for name, robot in ROBOTS.items()}
    printed = paper.PERCENT["hacking"].value / 100
    return {
        "printed": printed,
        "grid": reduction(ours, base),
        "walker": reduction(walker, base),
        "ours": ours,
        "baseline": base,
        "best": {name: max(1 - o / r for o, r in pairs) for name, pairs in printed_form.items()},
        "together": {
            name: 1 - sum(o for o, _ in pairs) / sum(r for _, r in pairs) for name, pairs in printed_form.items()
        },
        "settings": {name: len(pairs) for name, pairs in printed_form.items()},
        "well_specified": well_specified,
        "raw": raw,
        "kept": {name: None if found is None else float(found[1].mean()) for name, found in kept.items()},
        "repaired": sum(share >= printed for share in repaired),
        "of": len(repaired),
        "repaired_worst": min(repaired),
    }


J16 = Conditions(
    (
        Part("10x10 grid: visits fall by the printed share or more", lambda n: n["grid"] >= n["printed"]),
        *each(
            "{}: at best, hacks fall by the printed share or more",
            ROBOTS,
            lambda n, robot: n["best"][robot] >= n["printed"],
        ),
        *each("{}: all settings together, hacks fall", ROBOTS, lambda n, robot: n["together"][robot] > 0),
        Part(
            "10x10 grid whose bonus is real: the raw agent's true return is kept, nine tenths of it or more",
            lambda n: n["well_specified"].mean >= 0.9 * n["raw"].mean,
        ),
    ),
    _everywhere,
)


def _violations(mitigation: str, noise: float) -> dict[str, Summary] | None:
    """Return violations per episode of PPO and SAC on Hopper; None if they are not published."""
    p = published.packaged()
    found = {}
    for name, agent in AGENTS.items():
        rows = p.rows(locomotion.NOISE, agent=agent, mitigation=mitigation, noise=noise)
        if not rows:
            return None
        found[name] = p.of(rows[0], "hacks")
    return found


def _noisy(results: StudyResults) -> dict[str, Any] | None:
    clean, noisy, ours = _violations("raw", 0.0), _violations("raw", 0.3), _violations("uard-0.1", 0.3)
    if clean is None or noisy is None or ours is None:
        return None
    return {
        "clean": clean,
        "noisy": noisy,
        "ours": ours,
        "rise": paper.PERCENT["noise-rise"].value / 100,
        "cut": paper.PERCENT["noise-lower"].value / 100,
    }


J21 = Conditions(
    (
        *each(
            "{}: with 30 % noise violations are higher than without, by the printed share or more",
            AGENTS,
            lambda n, agent: n["noisy"][agent].mean > (1 + n["rise"]) * n["clean"][agent].mean,
        ),
        *each(
            "{}: with 30 % noise UARD's violations are lower, by the printed share or more",
            AGENTS,
            lambda n, agent: n["ours"][agent].mean < (1 - n["cut"]) * n["noisy"][agent].mean,
        ),
    ),
    _noisy,
)

_LEVELS = (10, 20, 30)  # per cent
GRID = {
    f"{panel} panel, noise in {unit}": (panel, label)
    for unit, label in (("reward units", "reward units"), ("units of the trap's reward", "of the trap's reward"))
    for panel in PANELS
}


def _degradation(results: StudyResults) -> dict[str, Any] | None:
    ours = [_violations("uard-0.1", percent / 100) for percent in _LEVELS]
    clean, noisy = _violations("raw", 0.0), _violations("raw", 0.3)
    if clean is None or noisy is None or None in ours:
        return None

    def grid(agent: str, percent: int, panel: str, unit: str) -> Summary:
        return results.get("noise", "hacks", agent=agent, panel=panel, percent=percent, unit=unit)

    def tabular(percent: int) -> dict[str, Summary]:
        return {"grid": grid("baseline", percent, "main", "of the trap's reward")}

    def worst(found: list[Summary]) -> Summary:
        return max(found, key=lambda s: s.mean)

    return {
        "grid": {name: worst([grid("uard-paper", x, *where) for x in _LEVELS]) for name, where in GRID.items()},
        "hopper": {name: worst([level[name] for level in ours if level]) for name in AGENTS},
        "clean": tabular(0) | clean,
        "noisy": tabular(30) | noisy,
    }


J25 = Conditions(
    (
        *each(
            "grid, {}: UARD makes less than one visit at 10, 20 and 30 %",
            GRID,
            lambda n, where: n["grid"][where].mean < FEW,
        ),
        *each(
            "Hopper, {}: UARD makes less than one violation at 10, 20 and 30 %",
            AGENTS,
            lambda n, agent: n["hopper"][agent].mean < FEW,
        ),
        *each(
            "{}: the baseline degrades: more violations at 30 % than at 0 (beyond noise)",
            ("grid", *AGENTS),
            lambda n, baseline: below_in(n["clean"], n["noisy"], baseline),
        ),
    ),
    _degradation,
)

REGIONS = ("vibration", "posture")


def _walking(results: StudyResults) -> dict[str, Any] | None:
    p = published.packaged()
    rows = {r["region"]: r for r in p.rows(locomotion.HACKING, robot="walker2d", agent="ppo", mitigation="true reward")}
    if not set(REGIONS) <= set(rows):
        return None
    low, sd = paper.TEXT["Walker2d reference"].value, 4.2  # line 995
    numbers: dict[str, Any] = paper.FIGURES["G7"].numbers
    return {
        "returns": {region: p.of(rows[region], "true_return") for region in REGIONS},
        "reference": Stat(low, sd),
        "exploit": numbers["baselines"],
    }


J36 = Conditions(
    (
        *each(
            "{}: an agent that has nothing to exploit returns what the paper's reference policy does, within its SD",
            REGIONS,
            lambda n, region: agrees(n["returns"][region], n["reference"]),
        ),
        *each(
            "{}: an agent that has nothing to exploit stays below the 350 that are said to show an exploit",
            REGIONS,
            lambda n, region: n["returns"][region].mean < n["exploit"],
        ),
    ),
    _walking,
)


def _worst_seed(results: StudyResults) -> dict[str, Any] | None:
    clean, noisy = _violations("raw", 0.0), _violations("raw", 0.3)
    if clean is None or noisy is None:
        return None
    return {
        "clean": {name: max(s.per_seed) for name, s in clean.items()},
        "noisy": {name: max(s.per_seed) for name, s in noisy.items()},
        "seeds": {name: len(s.per_seed) for name, s in noisy.items()},
        "printed": paper.TEXT["seed exceeds"].value,
    }


J45 = Conditions(
    (
        *each(
            "{}: at 30 % noise the worst seed has more violations than printed",
            AGENTS,
            lambda n, agent: n["noisy"][agent] > n["printed"],
        ),
        *each(
            "{}: because of the noise: the worst seed has more violations at 30 % than at 0",
            AGENTS,
            lambda n, agent: n["noisy"][agent] > n["clean"][agent],
        ),
    ),
    _worst_seed,
)

_KICKED = ("raw", "uard-paper", "uard-0.1")


def _kicked(results: StudyResults) -> dict[str, Any] | None:
    p, found = published.packaged(), {}
    for mitigation in _KICKED:
        rows = locomotion.drifting(p, robot="hopper", mitigation=mitigation)
        if not rows:
            return None
        found[mitigation] = locomotion.around_kick(p, rows[0])
    none, mild, hardest = examine.KICKS

    def rise(column: str) -> dict[str, Summary]:
        return {
            m: statistics.summarise(found[m][hardest, "kick"][column] - found[m][hardest, "before"][column])
            for m in _KICKED[1:]
        }

    def later(kick: float) -> dict[str, Summary]:
        return {m: statistics.summarise(found[m][kick, "later"]["standing"]) for m in _KICKED}

    return {c: rise(c) for c in ("sigma_m", "sigma_h", "weight")} | {
        "standing": later(hardest),
        "mild": later(mild),
        "unkicked": later(none),
    }


def _recovers(kick: str, n: Numbers, mitigation: str) -> bool | None:
    """Whether most copies stand later that would without a kick; None where none would."""
    unkicked = n["unkicked"][mitigation].mean
    return n[kick][mitigation].mean >= 0.9 * unkicked if unkicked > 0 else None


L1985 = Conditions(
    (
        Part(
            "the baseline is thrown off: fewer copies stand later than without a kick (paired)",
            lambda n: below(n["standing"]["raw"], n["unkicked"]["raw"]),
        ),
        *each(
            "{}: sigma_m rises (interval of the difference above 0)",
            _KICKED[1:],
            lambda n, m: above_zero(n["sigma_m"][m]),
        ),
        *each(
            "{}: sigma_h rises (interval of the difference above 0)",
            _KICKED[1:],
            lambda n, m: above_zero(n["sigma_h"][m]),
        ),
        *each(
            "{}: the reward counts less: the weight falls (interval of the difference below 0)",
            _KICKED[1:],
            lambda n, m: below_zero(n["weight"][m]),
        ),
        *each(
            "{}: kicked by 5 m/s it recovers: later nine tenths of the copies stand that would without a kick",
            _KICKED[1:],
            partial(_recovers, "standing"),
        ),
        *each(
            "{}: kicked by 1 m/s it recovers: later nine tenths of the copies stand that would without a kick",
            _KICKED[1:],
            partial(_recovers, "mild"),
        ),
        *each(
            "{}: kicked by 5 m/s it recovers more often than the baseline (paired, Holm)",
            _KICKED[1:],
            lambda n, m: below_in({k: n["standing"]["raw"] for k in _KICKED[1:]}, n["standing"], m),
        ),
    ),
    _kicked,
)

CONDITIONS = {"J16": J16, "J21": J21, "J25": J25, "J36": J36, "J45": J45, "L1985": L1985}
