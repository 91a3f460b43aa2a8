"""Reward-gaming gridworlds: where the hacks are."""

from __future__ import annotations

from uard.agents.tabular import QLearning
from uard.envs.grids.gaming import AbsentSupervisor, BoatRace, TomatoWatering
from uard.lab.cell import Cell
from uard.lab.registry import can_work, deep_agents, trainer
from uard.lab.studies.common import can_use
from uard.lab.studies.grids import COMPARED
from uard.lab.study import Row, Study, row
from uard.method.mitigations import named
from uard.training.feedback.rating_model import RatingModel

GAMES = {
    f"{type(game).__name__}{' (legitimate)' if game.legitimate else ''}": game
    for legitimate in (False, True)
    for game in (
        BoatRace(legitimate=legitimate),
        TomatoWatering(factor=0.1, legitimate=legitimate),
        AbsentSupervisor(legitimate=legitimate),
    )
}
EPISODES, TABULAR_EPISODES = 100, 500  # after 100, six moves of ten are still random; tabular agents are cheap
DEEP = ("dqn", "ppo")  # one with a network, one with a policy: ten seeds of these say more than three of all
MODEL = RatingModel(fits=64)  # with 16, no rule kept PPO off the bucket of TomatoWatering in so few steps
RULES = tuple(name for name in COMPARED if name not in ("screening", "uard-consistent"))


def gaming() -> tuple[Row, ...]:
    """The reward-gaming gridworlds and their legitimate twins: three agents with every rival.

    100 episodes, of tabular agents 500. Tomatoes pay 0.1 each, not the published 0.02, for the raters' noise (sd 0.1
    and more) would drown them. Deep agents listen to a model of each rater, whatever the rule: rules are compared
    here, not models.
    """
    agents = {"q-learning": QLearning(), **{name: deep_agents()[name] for name in DEEP}}
    return tuple(
        row(
            Cell(
                game,
                named(mitigation),
                agent,
                episodes=TABULAR_EPISODES if isinstance(agent, QLearning) else EPISODES,
                rating_model=None if isinstance(agent, QLearning) else MODEL,
            ),
            game=where,
            agent=name,
            mitigation=mitigation,
        )
        for where, game in GAMES.items()
        for name, agent in agents.items()
        if can_work(agent, game)
        for mitigation in RULES
        if can_use(named(mitigation), trainer(agent, game))
    )


def studies() -> tuple[Study, ...]:
    """Return what ``uard reproduce games`` runs."""
    return (
        Study("gaming", "Reward-gaming gridworlds, three agents, every rival", "DESIGN: where the hacks are", gaming()),
    )
