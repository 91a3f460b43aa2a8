"""Who is asked what: how many answers each rule for asking needs, against asking at random. An honest control.

Items are steps of grids, clips of Hopper, or pairs of such clips. Simulated raters (``random_panel`` of the run's seed)
answer what they are asked, in rounds of ten answers; after each round a reward is learned of all answers so far, and
regret says what it is worth:

* *grids*: the rewards of all state-actions are learned by ``uard``, the policy that is best for them is found by
  backward induction, and regret is (best - found) / (best - random walk) of exact true returns. Items are the
  state-actions that a random walk visits, and the policy that is best for the observed reward, half of whose actions
  are random.
* *clips*: of 150 clips of up to 50 steps the one is picked of which most was learned; regret is (best - picked) /
  (best - mean) of true rewards per step. To train a robot anew for every number of answers would take weeks, so what a
  robot would learn of these answers is not known. Half of the clips are of random actions and half of the best of a
  fifty random linear policies, by observed return.
* *pairs*: of 60 such clips 300 pairs are judged, and the clip is picked whose worth by Bradley and Terry is highest.

All rules are given the same answers: what a rater says of an item is drawn once for each seed. Who is asked answers,
unlike a rater of ``random_panel`` who leaves steps out, and nobody is asked twice about an item.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from uard import _checks
from uard.collect.acquisition import Acquisition, Known
from uard.envs.base import TableEnvironment
from uard.envs.grids.random_tasks import random_grid
from uard.envs.grids.trapgrid import TrapGrid
from uard.envs.locomotion.locomotion import Locomotion
from uard.lab.margins import learned
from uard.method.mitigations import named
from uard.ratings import bradley_terry
from uard.ratings.aggregate import aggregate
from uard.ratings.panels import Panel, draw, random_panel

TRAPS, GRIDS, CLIPS, PAIRS = "TrapGrid 8x8", "random grids", "Hopper clips", "pairs of Hopper clips"
RANDOM = "random"
RULES: dict[str, Any] = {
    RANDOM: "random",
    "disputed": "disputed",
    "least-known": "least-known",
    "highest-reward": "highest-reward",
    "near-ties": "near-ties",
    "half random, half disputed": {"random": 0.5, "disputed": 0.5},
    "half random, half highest-reward": {"random": 0.5, "highest-reward": 0.5},
}
OVERLAP = 7  # raters per item if nothing else is asked for: all that a random panel may have
ROUND = 10  # answers, after which it is decided anew what is asked
ANSWERS = (*range(0, 200, 10), *range(200, 400, 20), *range(400, 1201, 50))  # after which regret is measured
BUDGETS = (100, 200, 400, 800)  # of which the report shows the regret
TARGET = 0.25  # regret that is to be reached for good
EPISODES, GREEDY = 100, 0.5  # of exploration on grids; share of actions that are not random in every second one
COUNT, LENGTH, LATEST = 150, 50, 25  # clips, steps of a clip, and after how many a clip begins at the latest
POLICIES, TRIED, KEPT = 50, 150, 5  # linear policies, the steps that each is tried for, and how many are kept
PAIRED, JUDGED = 60, 300  # clips that stand in pairs, and pairs
SCALE = 0.3
"""Of a panel that rates clips: a good hop pays about 2 to 3 per step, where the goal of a grid pays 10."""


class Case(NamedTuple):
    """What is drawn for one seed.

    Attributes:
        known: Items and raters before the first answer.
        answers: (n, K) what each rater says of each item, NaN where she skips it.
        regret: Of what is learned from ratings (n, K).
    """

    known: Known
    answers: np.ndarray
    regret: Callable[[np.ndarray], float]


def settings() -> dict[str, Callable[[int], Case]]:
    """Return what is drawn, by setting."""
    return {TRAPS: lambda seed: grid_case(TrapGrid(8), seed), GRIDS: lambda seed: grid_case(random_grid(seed), seed),
            CLIPS: clip_case, PAIRS: pair_case}  # fmt: skip


def rules(setting: str) -> tuple[str, ...]:
    """Return which rules are compared in a setting: near ties are of pairs, and pairs have no observed reward."""
    left_out = "highest-reward" if setting == PAIRS else "near-ties"
    return tuple(name for name in RULES if left_out not in name)


def answering(seed: int, scale: float = 1.0) -> Panel:
    """Return the random panel of a seed as it is at a page: who is asked answers.

    Examples:
        >>> {rater.coverage for rater in answering(0).raters}
        {1.0}
    """
    panel = random_panel(seed, scale)
    return replace(panel, raters=tuple(replace(rater, coverage=1.0) for rater in panel.raters))


def grid_case(environment: TableEnvironment, seed: int) -> Case:
    """Return a grid's state-actions as items.

    Examples:
        >>> from uard.envs.grids.trapgrid import TrapGrid
        >>> case = grid_case(TrapGrid(6), seed=3)
        >>> case.answers.shape == case.known.ratings.shape, case.regret(case.answers) <= 1.5
        (True, True)

    Args:
        environment: The grid.
        seed: Of the panel, of exploration and of the answers.
    """
    random = np.random.default_rng([seed, 11])
    task, truth = environment.task(), environment.truth()
    observed, true = np.asarray(task.reward, float), np.asarray(truth.reward, float)
    state, action = np.nonzero(visited(environment, random))
    law = environment.rating_law(answering(seed))
    answers = draw(law.at(state, action), random)
    best, floor = value(environment, best_policy(environment, true), true), value(environment, None, true)

    def regret(ratings: np.ndarray) -> float:
        table = np.full(law.centre.shape, np.nan)
        table[state, action] = ratings
        reward = learned(aggregate(table, observed), named("uard"))
        return (best - value(environment, best_policy(environment, reward), true)) / (best - floor)

    return Case(Known.nothing(*_names("step", answers), observed[state, action]), answers, regret)


def visited(environment: TableEnvironment, random: np.random.Generator) -> np.ndarray:
    """Return which state-actions an explorer visits, (S, A) truth values.

    Args:
        environment: The grid.
        random: Source of chance.
    """
    task = environment.task()
    following, terminal = np.asarray(task.next_state), np.asarray(task.terminal)
    gaming = best_policy(environment, np.asarray(task.reward, float))
    seen = np.zeros(following.shape, bool)
    for episode in range(EPISODES):
        state, greedy = int(np.atleast_1d(task.start)[0]), GREEDY * (episode % 2)
        for policy in gaming:
            action = int(policy[state] if random.random() < greedy else random.integers(following.shape[1]))
            seen[state, action] = True
            if terminal[state, action]:
                break
            state = int(following[state, action])
    return seen


def best_policy(environment: TableEnvironment, reward: np.ndarray) -> np.ndarray:
    """Return the best action of every time and state, (T, S), by backward induction; of equal ones the first.

    Args:
        environment: The grid.
        reward: (S, A).
    """
    following, going = _dynamics(environment)
    worth, policy = np.zeros(len(reward)), list[np.ndarray]()
    for _ in range(int(environment.horizon)):
        action_worth = reward + going * worth[following]
        policy.append(action_worth.argmax(1))
        worth = action_worth.max(1)
    return np.array(policy[::-1])


def value(environment: TableEnvironment, policy: np.ndarray | None, reward: np.ndarray) -> float:
    """Return the exact return of a policy from the start.

    Examples:
        >>> from uard.envs.grids.trapgrid import TrapGrid
        >>> grid = TrapGrid(6)
        >>> round(value(grid, best_policy(grid, grid.truth().reward), grid.truth().reward), 3)  # ten steps
        9.1

    Args:
        environment: The grid.
        policy: (T, S) actions; None is a random walk.
        reward: (S, A).
    """
    following, going = _dynamics(environment)
    worth, every = np.zeros(len(reward)), np.arange(len(reward))
    for t in reversed(range(int(environment.horizon))):
        action_worth = reward + going * worth[following]
        worth = action_worth.mean(1) if policy is None else action_worth[every, policy[t]]
    return float(worth[np.atleast_1d(environment.task().start)].mean())


@cache
def _dynamics(environment: TableEnvironment) -> tuple[np.ndarray, np.ndarray]:
    task = environment.task()
    return np.asarray(task.next_state), 1.0 - np.asarray(task.terminal, float)


class Clips(NamedTuple):
    """Clips of a robot, (n,): mean observed and true reward per step, and whether any step is contested."""

    observed: np.ndarray
    true: np.ndarray
    contested: np.ndarray


@cache
def clips(seed: int, count: int = COUNT) -> Clips:
    """Make clips of Hopper; of every two the first is of random actions (needs MuJoCo).

    Args:
        seed: Of policies, first states and actions.
        count: How many.
    """
    random = np.random.default_rng([seed, 12])
    robot = Locomotion("hopper")
    weights = random.normal(size=(POLICIES, robot.features, robot.actions))
    kept = weights[np.argsort(-_tried(robot, weights, seed), kind="stable")[:KEPT]]
    of = np.arange(count) // 2 % KEPT
    begin = random.integers(0, LATEST, count)
    observed, true, steps = np.zeros((3, count))
    contested, ended = np.zeros((2, count), bool)
    simulator = robot.simulator(count, seed)
    for t in range(LATEST + LENGTH):
        policy = np.tanh(np.einsum("nf,nfa->na", simulator.observe(), kept[of]))
        anything = random.uniform(-1.0, 1.0, policy.shape)
        result = simulator.step(np.where((np.arange(count) % 2 == 0)[:, None], anything, policy))
        here = (begin <= t) & (t < begin + LENGTH) & ~ended
        observed += here * result.reward
        true += here * result.true_reward
        steps += here
        contested |= here & result.hack
        ended |= here & (result.terminated | result.truncated)
    simulator.close()
    return Clips(observed / steps, true / steps, contested)


def _tried(robot: Locomotion, weights: np.ndarray, seed: int) -> np.ndarray:
    """Return the observed return of each linear policy in its first episode."""
    simulator = robot.simulator(len(weights), seed)
    total, alive = np.zeros(len(weights)), np.ones(len(weights), bool)
    for _ in range(TRIED):
        result = simulator.step(np.tanh(np.einsum("nf,nfa->na", simulator.observe(), weights)))
        total += alive * result.reward
        alive &= ~(result.terminated | result.truncated)
    simulator.close()
    return total


def clip_case(seed: int) -> Case:
    """Return clips as items (needs MuJoCo)."""
    random = np.random.default_rng([seed, 13])
    made = clips(seed)
    answers = draw(answering(seed, SCALE).law(made.observed, made.true, made.contested), random)

    def regret(ratings: np.ndarray) -> float:
        return _missed(learned(aggregate(ratings, made.observed), named("uard")), made.true)

    return Case(Known.nothing(*_names("clip", answers), made.observed), answers, regret)


def pair_case(seed: int) -> Case:
    """Return pairs of clips as items (needs MuJoCo)."""
    random = np.random.default_rng([seed, 14])
    made = Clips._make(x[:PAIRED] for x in clips(seed))
    first, second = np.triu_indices(PAIRED, 1)
    chosen = random.permutation(len(first))[:JUDGED]
    first, second = first[chosen], second[chosen]
    law = answering(seed, SCALE).law(made.observed, made.true, made.contested)
    gap = draw(law.at(first), random) - draw(law.at(second), random)
    answers = np.where(np.isnan(gap), np.nan, 0.5 + 0.5 * np.sign(gap))

    def regret(ratings: np.ndarray) -> float:
        here = ~np.isnan(ratings)
        wins = np.where(here, ratings, 0.0).sum(1)
        return _missed(bradley_terry.worth(first, second, wins, here.sum(1).astype(float), PAIRED), made.true)

    return Case(Known.nothing(*_names("pair", answers), pairs=np.stack([first, second], 1)), answers, regret)


def _names(what: str, answers: np.ndarray) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return names of the items and of the raters."""
    n, raters = answers.shape
    return tuple(f"{what} {i}" for i in range(n)), tuple(f"rater {k}" for k in range(raters))


def _missed(score: np.ndarray, true: np.ndarray) -> float:
    """Return the regret of picking what has the highest score; ties count as their mean."""
    picked = true[score >= score.max()].mean()
    return float((true.max() - picked) / (true.max() - true.mean()))


def follow(case: Case, rule: Any, seed: int, overlap: int = OVERLAP) -> np.ndarray:
    """Return the regret after each number of ``ANSWERS``; where nothing is left to ask it stays.

    Args:
        case: What is asked about.
        rule: As ``Acquisition`` takes it.
        seed: Of the choices.
        overlap: Raters per item.
    """
    random = np.random.default_rng([seed, 15])
    acquisition, known = Acquisition(rule, overlap=overlap), case.known
    column = {name: k for k, name in enumerate(known.raters)}
    row = {name: i for i, name in enumerate(known.items)}
    found: list[float] = []
    given = 0
    for answers in ANSWERS:
        before = given
        while given < answers and (asked := acquisition.choose(known, min(ROUND, answers - given), random)):
            rows, columns = [row[r.item] for r in asked], [column[str(r.rater)] for r in asked]
            ratings, count = known.ratings.copy(), known.count.copy()
            ratings[rows, columns] = case.answers[rows, columns]
            count[rows, columns] += 1
            known = replace(known, ratings=ratings, count=count)
            given += len(asked)
        found.append(found[-1] if found and given == before else case.regret(known.ratings))
    return np.array(found)


@dataclass(frozen=True)
class Result:
    """Regrets of every rule.

    Examples:
        >>> regret = {(TRAPS, RANDOM): np.ones((2, len(ANSWERS)))}
        >>> Result((1, 3), 7, {TRAPS: ((4, 2), (4, 5))}, {TRAPS: (0.0, 0.5)}, regret).as_data()["settings"][0]["items"]
        [4, 4]

    Attributes:
        seeds: The seeds.
        overlap: Raters per item.
        sizes: Number of items and of raters for each seed, by setting.
        everything: Regret for each seed where every rater has rated every item, by setting.
        regret: (seeds, answers) by setting and rule.
    """

    seeds: tuple[int, ...]
    overlap: int
    sizes: dict[str, tuple[tuple[int, int], ...]]
    everything: dict[str, tuple[float, ...]]
    regret: dict[tuple[str, str], np.ndarray]

    def as_data(self) -> dict[str, Any]:
        """Return plain data that JSON can hold."""
        found = [
            {
                "setting": setting,
                "items": [items for items, _ in sizes],
                "raters": [raters for _, raters in sizes],
                "everything": [round(x, 4) for x in self.everything[setting]],
                "rules": [
                    {"rule": rule, "regret": regret.round(4).tolist()}
                    for (where, rule), regret in self.regret.items()
                    if where == setting
                ],
            }
            for setting, sizes in self.sizes.items()
        ]
        numbers = {"answers": list(ANSWERS), "budgets": list(BUDGETS), "target": TARGET, "round": ROUND}
        return {"seeds": list(self.seeds), "overlap": self.overlap, **numbers, "settings": found}


def run(seeds: Sequence[int], chosen: Sequence[str] | None = None, overlap: int = OVERLAP) -> Result:
    """Follow every rule for every seed.

    Examples:
        >>> result = run([0], [TRAPS])
        >>> result.regret[TRAPS, RANDOM].shape == (1, len(ANSWERS))
        True

    Args:
        seeds: Seeds >= 0, at least one.
        chosen: Some of ``settings``; all if left out.
        overlap: Raters per item, >= 1.

    Raises:
        InvalidValueError: there is no seed.
        UnknownNameError: for another setting, with the nearest name.
        ModuleNotFoundError: MuJoCo is needed and not there.
    """
    _checks.whole("number of seeds", len(seeds), low=1)
    every = settings()
    sizes: dict[str, tuple[tuple[int, int], ...]] = {}
    everything: dict[str, tuple[float, ...]] = {}
    regret: dict[tuple[str, str], np.ndarray] = {}
    for setting in every if chosen is None else chosen:
        cases = [every[_checks.choose("setting", setting, every)](seed) for seed in seeds]
        sizes[setting] = tuple((len(c.known.items), len(c.known.raters)) for c in cases)
        everything[setting] = tuple(c.regret(c.answers) for c in cases)
        for rule in rules(setting):
            followed = [follow(c, RULES[rule], seed, overlap) for c, seed in zip(cases, seeds, strict=True)]
            regret[setting, rule] = np.stack(followed)
    return Result(tuple(seeds), overlap, sizes, everything, regret)
