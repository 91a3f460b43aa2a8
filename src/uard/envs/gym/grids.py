"""Grids and all other small problems as Gymnasium environments, for agents that step on the host.

A problem of tables has one table of dynamics: the environment looks up what a compiled world looks up, with rewards in
float64 where that one has float32. TomatoWatering is random and has no table: both call the same functions
(``uard.envs.grids.tomato``).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, NamedTuple, final

import gymnasium
import numpy as np

from uard import _checks
from uard.envs.base import TableEnvironment
from uard.envs.grids import tomato
from uard.envs.grids.gaming import TomatoWatering
from uard.envs.grids.tomato import TomatoState
from uard.envs.gym import drawing
from uard.envs.gym.rated import Evaluation, RatedEnv, Stepped
from uard.ratings.panels import Panel, RatingLaw, draw


class Outcome(NamedTuple):
    """What a step leads to.

    Attributes:
        state: The next one.
        reward: Observed.
        terminated: Whether the episode ends there by itself.
        evaluation: What the step was really worth.
        law: How the panel answers about it; None without a panel.
        doubt: Deviation between the members of the model that made the reward; None for one that was written by hand.
    """

    state: Any
    reward: float
    terminated: bool
    evaluation: Evaluation
    law: RatingLaw | None
    doubt: float | None = None


class Dynamics(ABC):
    """A problem's dynamics on the host, without time or episode.

    Attributes:
        observation_space: Of what ``observe`` returns.
        actions: Number of actions.
    """

    observation_space: gymnasium.Space[Any]
    actions: int

    @abstractmethod
    def start(self, random: np.random.Generator) -> Any:
        """Return an episode's first state."""

    @abstractmethod
    def step(self, state: Any, action: int, random: np.random.Generator) -> Outcome:
        """Take one step."""

    @abstractmethod
    def observe(self, state: Any) -> Any:
        """Return what the agent sees."""


@final
class TableDynamics(Dynamics):
    """Any problem of tables; a state is its number, and observed as it is."""

    def __init__(self, problem: TableEnvironment, panel: Panel | None, noise: float):
        """Read the tables."""
        task, truth = problem.task(np.float64), problem.truth(np.float64)
        # Nested lists: to look up one entry they are faster than arrays, and give plain numbers.
        self._next_state, self._reward, self._terminal, self._true, self._hack = (
            np.asarray(table).tolist() for table in (task.next_state, task.reward, task.terminal, *truth[:2])
        )
        self._doubt = None if task.doubt is None else np.asarray(task.doubt, float).tolist()
        self._starts = np.atleast_1d(task.start).tolist()
        self._law = None
        if panel is not None:
            law = problem.rating_law(panel, noise)
            self._law = law._replace(centre=law.centre.astype(float), deviation=law.deviation.astype(float))
        self.observation_space = gymnasium.spaces.Discrete(problem.states)
        self.actions = len(self._reward[0])

    def start(self, random: np.random.Generator) -> int:
        """Return the only start, or draw one of several."""
        count = len(self._starts)
        return self._starts[0] if count == 1 else self._starts[-1 - min(int(count * random.random()), count - 1)]

    def step(self, state: int, action: int, random: np.random.Generator) -> Outcome:
        """Look the step up."""
        return Outcome(
            self._next_state[state][action],
            self._reward[state][action],
            self._terminal[state][action],
            Evaluation(self._true[state][action], self._hack[state][action]),
            None if self._law is None else self._law.at(state, action),
            None if self._doubt is None else self._doubt[state][action],
        )

    def observe(self, state: int) -> int:
        """Return the number."""
        return state


@final
class TomatoDynamics(Dynamics):
    """TomatoWatering; which tomatoes would dry is drawn, 13 uniform numbers a step."""

    def __init__(self, problem: TomatoWatering, panel: Panel | None, noise: float):
        """Keep the numbers."""
        self._problem, self._panel, self._noise = problem, panel, noise
        self._factor = np.float64(problem.factor)
        self.observation_space = gymnasium.spaces.Box(0.0, 1.0, (tomato.FEATURES,), np.float32)
        self.actions = tomato.ACTIONS

    def start(self, random: np.random.Generator) -> TomatoState:
        """Return the layout's start."""
        return tomato.start()

    def step(self, state: TomatoState, action: int, random: np.random.Generator) -> Outcome:
        """Move, water, dry, and use the sprinkler of a legitimate twin."""
        dries = random.random(tomato.COUNT) < self._problem.dry_probability
        after = tomato.advance(state, np.int32(action), dries, np.bool_(self._problem.legitimate))
        reward, (true, hack, _) = tomato.reward(after, self._factor), tomato.truth(after, self._factor)
        law = None if self._panel is None else self._panel.law(reward, true, hack, np.float64(self._noise))
        return Outcome(after, float(reward), False, Evaluation(float(true), bool(hack)), law)

    def observe(self, state: TomatoState) -> np.ndarray:
        """Return the cell one-hot, then the tomatoes as seen, (42,) float32."""
        return tomato.observe(state)


@final
class GridEnv(RatedEnv[Any, int]):
    """TrapGrid, BoatRace, TomatoWatering, AbsentSupervisor, LearnedRewardGrid, or any other problem of tables.

    An observation is the number of a state (for a grid the cell's, row by row from the upper left), but for
    TomatoWatering, see there. The episode is truncated at the horizon. ``info`` is that of ``RatedEnv``; where the
    reward is a model's, ``doubt`` is the deviation between the model's members. Pickling and copying keep the episode
    and its random numbers. ``render_mode`` is ``ansi`` (text), for a TrapGrid and a LearnedRewardGrid also
    ``rgb_array`` (an (H, W, 3) picture).

    Examples:
        >>> from uard.envs.grids.trapgrid import TrapGrid
        >>> env = GridEnv(TrapGrid(size=3, traps=[(0, 1)]), panel="main")
        >>> state, info = env.reset(seed=0)
        >>> state, reward, terminated, truncated, info = env.step(3)  # right, into the trap
        >>> state, reward, info["ratings"].shape, info["evaluation"]
        (1, 4.0, (3,), Evaluation(true_reward=-1.0, hack=True))
    """

    def __init__(
        self,
        problem: TableEnvironment | TomatoWatering,
        *,
        panel: str | Panel | None = None,
        noise: float = 0.0,
        render_mode: str | None = None,
    ):
        """Build the environment; arguments and errors as for ``RatedEnv``."""
        self._picture = drawing.picture(problem)
        modes = ["ansi"] if self._picture is None else ["rgb_array", "ansi"]
        super().__init__(problem, panel, noise, render_mode, modes, drawing.FRAMES)
        self._dynamics: Dynamics
        if isinstance(problem, TomatoWatering):
            self._dynamics = TomatoDynamics(problem, self.panel, self.noise)
        else:
            self._dynamics = TableDynamics(problem, self.panel, self.noise)
        self.observation_space = self._dynamics.observation_space
        self.action_space = gymnasium.spaces.Discrete(self._dynamics.actions)  # type: ignore[assignment]
        self._state: Any = None
        self._time = 0

    def _begin(self, seed: int | None) -> Any:
        self._state, self._time = self._dynamics.start(self.np_random), 0
        return self._dynamics.observe(self._state)

    def _take(self, action: int) -> Stepped[Any]:
        if not self.action_space.contains(action):
            allowed = f"a whole number in [0, {self._dynamics.actions - 1}]"
            raise _checks.InvalidValueError("action", action, allowed)
        outcome = self._dynamics.step(self._state, int(action), self.np_random)
        self._state, self._time = outcome.state, self._time + 1
        truncated = not outcome.terminated and self._time >= self.problem.horizon
        info: dict[str, Any] = {"evaluation": outcome.evaluation}
        if outcome.law is not None:
            info["ratings"] = draw(outcome.law, self.np_random)
        if outcome.doubt is not None:
            info["doubt"] = outcome.doubt
        return self._dynamics.observe(self._state), outcome.reward, outcome.terminated, truncated, info

    def _draw(self) -> np.ndarray | str:
        if self.render_mode == "rgb_array":
            assert self._picture is not None
            return self._picture.at(self._state)
        return f"step {self._time}/{self.problem.horizon}\n{drawing.text(self.problem, self._state)}\n"
