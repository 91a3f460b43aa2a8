"""What an environment is to a compiled training loop: pure functions of a compact state.

A world is a pytree (its numbers are data, so that one program serves many worlds) with the methods of ``World``, each
for one state; loops map them over batches. What an agent may see of a step is what ``observe``, ``step`` and the
panel's ratings give. ``evaluate`` is for evaluation only: loops write it into their log and hand it to no agent, model
of ratings or mitigation.

A world's class is registered by ``register_pytree_node_class``, or is told from others by a static field: JAX 0.10
takes two classes registered by ``register_dataclass`` for one structure if their fields are alike, and ``jit`` may mix
them up.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from uard.envs.tables import MIN_STATES, HiddenTruth, Task, pad
from uard.ratings.panels import RatingLaw


class Step(NamedTuple):
    """One step: the state it leads to, the observed reward, whether the episode ends there, the reward's own doubt.

    ``doubt`` is the deviation between the members of the model that made the observed reward; 0 for a reward that was
    written by hand.
    """

    state: Any
    reward: Array
    terminated: Array
    doubt: Array


@runtime_checkable
class World(Protocol):
    """An episodic environment with discrete actions, its panel of annotators included.

    An action is a whole number in [0, ``actions``), () int32.

    Examples:
        >>> from uard.envs.names import build
        >>> from uard.ratings.panels import MAIN
        >>> world = build("TomatoWatering", dry_probability=0.0).world(MAIN)
        >>> isinstance(world, World), world.actions, world.features, world.raters
        (True, 4, 42, 3)
        >>> key = jax.random.key(0)
        >>> after = jax.jit(world.step)(world.reset(key), 3, key)
        >>> round(float(after.reward), 2), bool(after.terminated)  # eight tomatoes are watered
        (0.16, False)

    Attributes:
        actions: Number of actions.
        features: Length of an observation.
        raters: Number of annotators K.
        slots: ``slot`` is below this.
        horizon: Steps after which an episode is cut off.
    """

    @property
    def actions(self) -> int:
        """Number of actions."""
        ...

    @property
    def features(self) -> int:
        """Length of an observation."""
        ...

    @property
    def raters(self) -> int:
        """Number of annotators K."""
        ...

    @property
    def slots(self) -> int:
        """``slot`` is below this."""
        ...

    @property
    def horizon(self) -> Array:
        """Steps after which an episode is cut off."""
        ...

    def reset(self, key: Array) -> Any:
        """Return an episode's first state: any pytree of small arrays."""
        ...

    def step(self, state: Any, action: Array, key: Array) -> Step:
        """Take one step."""
        ...

    def observe(self, state: Any) -> Array:
        """Return the observation: (features,) float32, or () int32 for the place of the one in a one-hot vector."""
        ...

    def slot(self, state: Any, action: Array) -> Array:
        """Return a number of the state-action: equal ones have equal numbers; different ones rarely share one."""
        ...

    def evaluate(self, state: Any, action: Array, after: Step) -> HiddenTruth:
        """Return what a step was really worth; for evaluation only."""
        ...

    def rating_law(self, state: Any, action: Array, after: Step) -> RatingLaw:
        """Return how the panel answers about a step: (K,) centre and deviation."""
        ...


@jax.tree_util.register_pytree_node_class
@dataclass(frozen=True)
class TableWorld:
    """A small problem given as tables; the state is a number, observed as it is: it stands for the one-hot row.

    Examples:
        >>> from uard.envs.grids.trapgrid import TrapGrid
        >>> from uard.ratings.panels import MAIN
        >>> world = TrapGrid(size=3, traps=[(0, 1)]).world(MAIN)
        >>> after = world.step(0, 3, jax.random.key(0))  # right, into the trap
        >>> int(after.state), float(after.reward), float(world.evaluate(0, 3, after).reward)
        (1, 4.0, -1.0)

    Attributes:
        task: What an agent meets; ``start`` may hold several states, of which each episode draws one.
        truth: What the evaluation sees.
        law: How the panel answers about every step.
    """

    task: Task
    truth: HiddenTruth
    law: RatingLaw

    def tree_flatten(self) -> tuple[tuple[Any, ...], None]:
        """Give JAX the tables."""
        return (self.task, self.truth, self.law), None

    @classmethod
    def tree_unflatten(cls, aux: None, children: Any) -> TableWorld:
        """Take them back."""
        return cls(*children)

    @property
    def actions(self) -> int:
        """Number of actions."""
        return self.task.reward.shape[1]

    @property
    def features(self) -> int:
        """Number of states."""
        return self.task.reward.shape[0]

    @property
    def raters(self) -> int:
        """Number of annotators."""
        return self.law.centre.shape[-1]

    @property
    def slots(self) -> int:
        """Number of state-actions."""
        return self.features * self.actions

    @property
    def horizon(self) -> Array:
        """Steps per episode."""
        return self.task.horizon

    def reset(self, key: Array) -> Array:
        """Draw one of the starts."""
        starts = jnp.atleast_1d(jnp.asarray(self.task.start, jnp.int32))
        return starts[jax.random.randint(key, (), 0, starts.shape[0])]

    def step(self, state: Array, action: Array, key: Array) -> Step:
        """Look the step up."""
        place = state, action
        task = self.task
        doubt = jnp.float32(0.0) if task.doubt is None else task.doubt[place]
        return Step(task.next_state[place], task.reward[place], task.terminal[place], doubt)

    def observe(self, state: Array) -> Array:
        """Return the state: the place of the one in its one-hot vector."""
        return jnp.asarray(state, jnp.int32)

    def slot(self, state: Array, action: Array) -> Array:
        """Return the number of the state-action; none share one."""
        return state * self.actions + action

    def evaluate(self, state: Array, action: Array, after: Step) -> HiddenTruth:
        """Look the truth up."""
        return HiddenTruth(*(table[state, action] for table in self.truth))

    def rating_law(self, state: Array, action: Array, after: Step) -> RatingLaw:
        """Look the panel's answers up."""
        return self.law.at(state, action)


def table_world(task: Task, truth: HiddenTruth, law: RatingLaw, states: int = MIN_STATES) -> TableWorld:
    """Build a world of tables, padded so that small ones share one compiled program.

    Examples:
        >>> from uard.envs.grids.trapgrid import TrapGrid
        >>> from uard.ratings.panels import MAIN
        >>> grid = TrapGrid(size=3)
        >>> world = table_world(grid.task(), grid.truth(), grid.rating_law(MAIN))
        >>> grid.states, world.features, world.slots
        (9, 100, 400)

    Args:
        task: What an agent meets, (S, A) tables.
        truth: What the evaluation sees, (S, A) tables.
        law: How the panel answers about every step, (S, A, K).
        states: Least number of states; those that are added cannot be reached.
    """
    states = max(states, task.next_state.shape[0])
    starts = np.atleast_1d(np.asarray(task.start, np.int32))
    task = task._replace(start=np.resize(starts, max(len(starts), 2)))  # one start twice: the same program as for two
    return TableWorld(pad(task, states), pad(truth, states), pad(law, states))
