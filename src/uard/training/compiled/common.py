"""What the loops of all deep agents share: lanes, budgets, logs, ratings, the watch for divergence."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from uard.agents.networks import batched_index
from uard.envs.tables import Ratings
from uard.envs.world import Step, TableWorld, Verdict, World
from uard.method.mitigations import Feedback, Mitigation
from uard.training.feedback import rating_model as learned
from uard.training.feedback import running
from uard.training.feedback.rating_model import RatingModel
from uard.training.tracing import traceable

CHUNK = 128  # steps between fits of the rating model; what is usual is measured then
ROOM = 10  # a program has room for this many lanes, or a multiple
EXPLODED = 1e8  # of the unit of values: larger ones are called divergence
QUANTITIES = ("nothing", "loss", "values", "parameters", "rating model", "reward")  # what can diverge, by number


class Lane(NamedTuple):
    """One run, as data."""

    world: Any
    agent: Any
    mitigation: Mitigation
    feedback: RatingModel | None
    rated: Any
    seed: Any


@dataclass(frozen=True)
class Program:
    """What is fixed when the program is compiled.

    Attributes:
        episodes: Training ends after this many.
        steps: Or after this many environment steps; without end if None.
        ddof: Of the annotators' deviation.
        walk: Longest recorded walk of the trained agent without exploration.
    """

    episodes: int = 500
    steps: int | None = None
    ddof: int = 0
    walk: int = 128


class Outcome(NamedTuple):
    """What a run leaves behind.

    Attributes:
        log: (episodes, len(LOG)) per-episode sums; rows that were not reached are 0.
        episodes: How many rows count.
        steps: Environment steps taken.
        feedback: For worlds of tables: what is known of all state-actions' ratings, ``Feedback`` of (S, A) arrays.
        rated: For worlds of tables: how often each state-action was rated, (S x A,).
        values: For worlds of tables: mean, deviation and lowest of the ensemble's values, (S, A) each.
        walk: One episode of the trained agent without exploration: slots (walk,), -1 after its end, and the observed
            rewards.
        fault: Which of ``QUANTITIES`` diverged; 0 is none.
        fault_step: Environment steps when that was seen.
        good: The agent's state when all was well last.
        good_step: Environment steps then.
    """

    log: Array
    episodes: Array
    steps: Array
    feedback: Any
    rated: Any
    values: Any
    walk: Any
    fault: Array
    fault_step: Array
    good: Any
    good_step: Array


def lane(
    world: World,
    agent: Any,
    mitigation: Mitigation,
    seed: int,
    rated: float = 1.0,
    feedback: RatingModel | None = None,
) -> Lane:
    """Build a lane; ``feedback`` None keeps running means and knows nothing of what was never rated."""
    model = None if feedback is None else traceable(feedback)
    return Lane(world, traceable(agent), traceable(mitigation), model, np.float32(rated), np.uint32(seed))


def key_of(seed: Array, stream: int) -> Array:
    """Return a key; ratings and the environment have streams of their own, so that no agent's draws shift them."""
    return jax.random.fold_in(jax.random.wrap_key_data(jnp.stack([seed, jnp.uint32(0)]), impl="threefry2x32"), stream)


OWN, WORLD, PANEL, MODEL, INIT = range(5)  # streams
FIRST, LAST = 2**31, 2**31 + 1  # numbers that no chunk has


class FeedbackSource:
    """What a lane's raters say and what is known of it, for both kinds of loop; all methods are pure."""

    def __init__(self, one: Lane, program: Program):
        """Bind a lane."""
        self.world, self.mitigation, self.spec, self.rated = one.world, one.mitigation, one.feedback, one.rated
        self.used = one.mitigation.reads_feedback
        self.ddof = program.ddof
        self.seed = one.seed
        # A model changes once a chunk; what it says of a small world is then written down, to be looked up.
        self.tabulates = isinstance(one.world, TableWorld)

    def init(self) -> tuple[learned.Memory, Any]:
        """Return an empty memory and a fresh model."""
        state = jax.eval_shape(self.world.reset, jax.random.key(0))
        state = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), state)
        slots = self.world.slots if self.used else 1
        model = ()
        if self.used and self.spec is not None:
            model = learned.init(self.spec, key_of(self.seed, MODEL), self.world.features, self.world.actions)
            model = model, self._table(model)
        return learned.memory(slots, state), model

    def _table(self, model: learned.Model) -> Any:
        if not self.tabulates:
            return ()
        assert self.spec is not None
        observations = jax.vmap(self.world.observe)(jnp.arange(self.world.features))
        return learned.read(self.spec, model, observations, self.world.actions, self.world.raters)

    def record(self, known: learned.Memory, state: Any, action: Array, after: Step, key: Array) -> learned.Memory:
        """Ask the panel about a step, if this step is one that is rated."""
        if not self.used:
            return known
        noise, chance = jax.random.split(key)
        said: Ratings = self.world.rate(state, action, after)
        spoken = said.centre + said.deviation * jax.random.normal(noise, said.centre.shape)
        rated = (jax.random.uniform(chance) < self.rated).astype(jnp.float32)
        rated = rated if said.reach is None else rated * said.reach
        summary = running.summarise(spoken, self.ddof)
        return learned.remember(known, self.world.slot(state, action), state, action, summary, after.reward, rated)

    def fit(self, known: learned.Memory, model: Any, key: Array) -> Any:
        """Fit the model to what was recorded."""
        if not self.used or self.spec is None:
            return model
        fitted = learned.fit(self.spec, model[0], known, self.world.observe, self.world.actions, key)
        return fitted, self._table(fitted)

    def usual(self, known: learned.Memory, model: Any) -> Any:
        """Return what is usual over the distinct state-actions rated so far."""
        if not self.used:
            return self.mitigation.usual(self._nothing((1,)), jnp.zeros(1, bool))
        seen = known.rows[:, 0] > 0
        return self.mitigation.usual(self.of_memory(known, model), seen)

    def of_memory(self, known: learned.Memory, model: Any) -> Feedback:
        """Return the feedback of every slot's state-action, (M,) arrays."""
        if self.spec is None:
            return running.read(known.rows, self.world.raters)
        return self.of(known, model, known.states, known.actions)

    def of(self, known: learned.Memory, model: Any, states: Any, actions: Array) -> Feedback:
        """Return the feedback of state-actions, (B,) arrays."""
        if not self.used:
            return self._nothing(actions.shape)
        if self.spec is None:
            return running.read(known.rows[jax.vmap(self.world.slot)(states, actions)], self.world.raters)
        every = self.of_all(known, model, states)
        return Feedback._make([*(batched_index(x, actions) for x in every[:5]), every.raters])

    def of_all(self, known: learned.Memory, model: Any, states: Any) -> Feedback:
        """Return the feedback of all actions in states, (B, A) arrays."""
        actions = self.world.actions
        if not self.used:
            return self._nothing((jax.tree.leaves(states)[0].shape[0], actions))
        if self.spec is None:
            each = jax.vmap(lambda s: jax.vmap(lambda a: self.world.slot(s, a))(jnp.arange(actions)))(states)
            return running.read(known.rows[each], self.world.raters)
        fitted, table = model
        if self.tabulates:
            return Feedback._make([*(x[states] for x in table[:5]), table.raters])
        observations = jax.vmap(self.world.observe)(states)
        return learned.read(self.spec, fitted, observations, actions, self.world.raters)

    def _nothing(self, shape: tuple[int, ...]) -> Feedback:
        zeros = jnp.zeros((*shape, running.FIELDS), jnp.float32)
        return running.read(zeros, self.world.raters)


def counted(verdict: Verdict, after: Step) -> Array:
    """Return what a step adds to its episode's row of the log, (len(LOG),)."""
    adds = [verdict.hack, verdict.reward, after.reward, verdict.goal, 1.0, 0.0]
    return jnp.stack([jnp.asarray(x, jnp.float32) for x in adds])


def is_over(world: World, time: Array, after: Step) -> Array:
    """Whether the step taken at ``time`` was its episode's last, by termination or by the horizon."""
    return after.terminated | (time + 1 >= world.horizon)


def goes_on(program: Program, episode: Array, steps: Array, watch: Watch) -> Array:
    """Whether a run has budget left and has not diverged."""
    going = (episode < program.episodes) & (watch.fault == 0)
    return going if program.steps is None else going & (steps < program.steps)


class Watch(NamedTuple):
    """The watch for divergence, and the last state in which all was well: see ``Outcome``."""

    fault: Array
    fault_step: Array
    good: Any
    good_step: Array

    @staticmethod
    def start(agent: Any) -> Watch:
        """Begin to watch."""
        return Watch(jnp.int32(0), jnp.int32(0), agent, jnp.int32(0))

    def after(
        self, steps: Array, agent: Any, loss: Array, largest: Array, model: Any, reward: Array, unit: Array | float
    ) -> Watch:
        """Look at a chunk's results; name the first quantity that is not finite, or values beyond all measure."""
        bad = jnp.stack(
            [
                jnp.asarray(True),
                ~jnp.isfinite(loss),
                ~(largest <= EXPLODED * unit),
                ~all_finite(agent),
                ~all_finite(model),
                ~all_finite(reward),
            ]
        )
        # The reward first: it is the cause of what follows it.
        order = jnp.array([5, 4, 1, 2, 3, 0])
        fault = order[jnp.argmax(bad[order])].astype(jnp.int32)
        fine = fault == 0
        good = jax.tree.map(lambda new, old: jnp.where(fine, new, old), agent, self.good)
        return Watch(fault, jnp.where(fine, 0, steps), good, jnp.where(fine, steps, self.good_step))


def all_finite(tree: Any) -> Array:
    """Whether all floats of a pytree are finite."""
    floats = [x for x in jax.tree.leaves(tree) if jnp.issubdtype(jnp.asarray(x).dtype, jnp.floating)]
    return jnp.all(jnp.stack([jnp.isfinite(x).all() for x in floats])) if floats else jnp.asarray(True)


def outcome(
    one: Lane, program: Program, source: FeedbackSource, carry: Any, watch: Watch, greedy: Any, read: Any
) -> Outcome:
    """Gather what a run leaves behind; ``greedy`` acts, ``read`` gives mean, deviation and lowest value."""
    world = one.world
    feedback, rated, values = (), (), ()
    if isinstance(world, TableWorld):
        states = jnp.arange(world.features)
        feedback = source.of_all(carry.known, carry.model, states)
        feedback = feedback._replace(raters=jnp.broadcast_to(feedback.raters, feedback.mean.shape))
        values = read(states)
        rated = carry.known.rows[:, 0]

    def stride(c: tuple[Any, Array], key: Array) -> tuple[tuple[Any, Array], tuple[Array, Array]]:
        state, over = c
        act_key, step_key = jax.random.split(key)
        action = greedy(state, act_key)
        after = world.step(state, action, step_key)
        seen = jnp.where(over, -1, world.slot(state, action)), jnp.where(over, 0.0, after.reward)
        return (after.state, over | after.terminated), seen

    key = jax.random.fold_in(key_of(one.seed, WORLD), LAST)
    times = jnp.arange(program.walk)
    keys = jax.random.split(key, program.walk)

    def timed(c: Any, x: Any) -> Any:
        time, k = x
        (state, over), seen = stride((c[0], c[1] | (time >= world.horizon)), k)
        return (state, over), seen

    _, walk = lax.scan(timed, (world.reset(key), jnp.asarray(False)), (times, keys))
    return Outcome(
        log=carry.log[:-1],
        episodes=jnp.minimum(carry.episode, program.episodes),
        steps=carry.steps,
        walk=walk,
        feedback=feedback,
        rated=rated,
        values=values,
        fault=watch.fault,
        fault_step=watch.fault_step,
        good=watch.good,
        good_step=watch.good_step,
    )
