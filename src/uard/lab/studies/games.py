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
EPISODES = 100
# Rules that ask who said what, and the model of version 0.1 with which all others were trained here so far.
BY_RATER = ("uard", "median", "min-proxy-mean", "min-proxy-median", "excess")
RATINGS = RatingModel(predicts="ratings")


def gaming() -> tuple[Row, ...]:
    """The reward-gaming gridworlds and their legitimate twins: every agent with every mitigation.

    100 episodes. Tomatoes pay 0.1 each, not the published 0.02, so that the raters' noise (sd 0.1 and more) does not
    drown them.
    """
    agents = {"q-learning": QLearning(), **deep_agents()}
    return tuple(
        row(
            Cell(
                game,
                named(mitigation),
                agent,
                episodes=EPISODES,
                rating_model=None
                if isinstance(agent, QLearning)
                else RatingModel()
                if mitigation in BY_RATER
                else RATINGS,
            ),
            game=where,
            agent=name,
            mitigation=mitigation,
        )
        for where, game in GAMES.items()
        for name, agent in agents.items()
        if can_work(agent, game)
        for mitigation in COMPARED
        if can_use(named(mitigation), trainer(agent, game))
    )


def studies() -> tuple[Study, ...]:
    """Return what ``uard reproduce games`` runs."""
    return (
        Study(
            "gaming", "Reward-gaming gridworlds, every agent and mitigation", "DESIGN: where the hacks are", gaming()
        ),
    )
