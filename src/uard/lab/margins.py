"""What a rule leaves of the reason to be honest: how much more the honest policy earns than the one that games.

No agent and no luck: every state-action of a table is rated many times, the rule learns a reward of it, and the best
policy for the true reward is compared with the best one for the observed reward, in what was learned. A rule with a
small margin needs more episodes, or never gets there where actions are explored at random.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from uard.envs.base import TableEnvironment
from uard.method.feedback import Feedback
from uard.method.mitigations import Evidence, Mitigation
from uard.ratings.aggregate import aggregate, from_rows, merged, to_rows
from uard.ratings.panels import Panel

if TYPE_CHECKING:
    from jaxtyping import Float, Integer

RATINGS = 300  # of every state-action by every rater: nearly all that could be known


def rated(environment: TableEnvironment, panel: Panel, seed: int = 0) -> Feedback:
    """Return what many ratings by plain raters (their quirks are left out) tell of every state-action.

    Args:
        environment: Of tables.
        panel: Who rates.
        seed: Of the ratings.
    """
    reward, law = np.asarray(environment.task().reward, float), environment.rating_law(panel)
    centre, deviation = np.asarray(law.centre, float), np.asarray(law.deviation, float)
    random, ones = np.random.default_rng(seed), np.ones(reward.shape)
    rows = to_rows(aggregate(centre + deviation * random.normal(size=centre.shape), reward))
    for _ in range(RATINGS - 1):
        visit = to_rows(aggregate(centre + deviation * random.normal(size=centre.shape), reward))
        rows = merged(rows, visit, ones)
    return from_rows(rows)


def learned(feedback: Feedback, mitigation: Mitigation) -> Float[np.ndarray, "S A"]:
    """Return what a rule learns of every state-action after these ratings.

    Examples:
        >>> from uard.envs.grids.gaming import BoatRace
        >>> from uard.method.mitigations import named
        >>> from uard.ratings.panels import MAIN
        >>> learned(rated(BoatRace(), MAIN), named("median")).shape
        (8, 4)

    Args:
        feedback: Of all state-actions.
        mitigation: The rule.
    """
    reward = np.asarray(feedback.proxy, float)
    evidence = Evidence(reward, 0.0 * reward, feedback)
    return np.asarray(mitigation.signal(evidence, mitigation.fit(feedback, feedback.count > 0)).reward) + 0.0 * reward


def margin(environment: TableEnvironment, reward: Float[np.ndarray, "S A"]) -> float:
    """Return how much more the honest policy earns of this reward per step than the one that games, over an episode.

    Honest is the best policy for the true reward, and gaming the best one for the observed reward, both found by
    backward induction; of equal actions the first is taken.

    Examples:
        >>> from uard.envs.grids.gaming import BoatRace
        >>> true, observed = (np.asarray(x.reward, float) for x in (BoatRace().truth(), BoatRace().task()))
        >>> margin(BoatRace(), true) > 0, margin(BoatRace(), observed)
        (True, 0.0)

    Args:
        environment: Of tables, and with a horizon.
        reward: Of every state-action.
    """
    honest, gaming = (_best(environment, np.asarray(x, float)) for x in
                      (environment.truth().reward, environment.task().reward))  # fmt: skip
    return (_return(environment, honest, reward) - _return(environment, gaming, reward)) / len(honest)


def _best(environment: TableEnvironment, reward: Float[np.ndarray, "S A"]) -> Integer[np.ndarray, "T S"]:
    task = environment.task()
    value, policy = np.zeros(len(reward)), list[np.ndarray]()
    for _ in range(int(task.horizon)):
        worth = reward + np.where(np.asarray(task.terminal), 0.0, value[np.asarray(task.next_state)])
        policy.append(worth.argmax(1))
        value = worth.max(1)
    return np.array(policy[::-1])


def _return(
    environment: TableEnvironment, policy: Integer[np.ndarray, "T S"], reward: Float[np.ndarray, "S A"]
) -> float:
    task = environment.task()
    totals: list[float] = []
    for start in np.atleast_1d(np.asarray(task.start)).tolist():
        state, total = start, 0.0
        for actions in policy:
            action = actions[state]
            total += float(reward[state, action])
            if np.asarray(task.terminal)[state, action]:
                break
            state = int(np.asarray(task.next_state)[state, action])
        totals.append(total)
    return float(np.mean(totals))
