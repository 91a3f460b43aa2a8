"""What the loops of all deep agents share: runs, budgets, logs, ratings, the watch for divergence."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from uard.envs.tables import HiddenTruth
from uard.envs.world import Step, TableWorld, World
from uard.method.mitigations import Feedback, Mitigation
from uard.ratings.aggregate import aggregate, from_rows, nothing
from uard.ratings.panels import UNIFORMS, answers
from uard.training.feedback import rating_model
from uard.training.feedback.rating_model import RatingModel
from uard.training.tracing import traceable

CHUNK = 128  # steps between fits of the rating model; the panel's statistics are measured then
ROOM = 10  # a program has room for this many runs, or a multiple
EXPLODED = 1e8  # of the unit of values: larger ones are called divergence
QUANTITIES = ("nothing", "loss", "values", "parameters", "rating model", "reward")  # what can diverge, by number


class Run(NamedTuple):
    """One run, as data."""

    world: Any
    agent: Any
    mitigation: Mitigation
    rating_model: RatingModel | None
    rated: Any
    seed: Any


@dataclass(frozen=True)
class Program:
    """What is fixed when the program is compiled.

    Attributes:
        episodes: Training ends after this many.
        steps: Or after this many environment steps; without end if None.
        ddof: Of the raters' deviation.
        walk: Longest recorded walk of the trained agent without exploration.
    """

    episodes: int = 500
    steps: int | None = None
    ddof: int = 0
    walk: int = 128


class TrainedAgent(NamedTuple):
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


def make_run(
    world: World,
    agent: Any,
    mitigation: Mitigation,
    seed: int,
    rated: float = 1.0,
    rating_model: RatingModel | None = None,
) -> Run:
    """Build a run; without a model of ratings nothing is known of what was never rated."""
    model = None if rating_model is None else traceable(rating_model)
    return Run(world, traceable(agent), traceable(mitigation), model, np.float32(rated), np.uint32(seed))


def key_of(seed: Array, stream: int) -> Array:
    """Return a key; ratings and the environment have streams of their own, so that no agent's draws shift them."""
    return jax.random.fold_in(jax.random.wrap_key_data(jnp.stack([seed, jnp.uint32(0)]), impl="threefry2x32"), stream)


OWN, WORLD, PANEL, MODEL, INIT = range(5)  # streams
FIRST, LAST = 2**31, 2**31 + 1  # numbers that no chunk has


class FeedbackSource:
    """What a run's raters say and what is known of it, for both kinds of loop; all methods are pure."""

    def __init__(self, run: Run, program: Program):
        """Bind a run."""
        self.world, self.mitigation, self.spec, self.rated = run.world, run.mitigation, run.rating_model, run.rated
        self.used = run.mitigation.reads_feedback
        self.ddof = program.ddof
        self.seed = run.seed
        # A model changes once a chunk; what it predicts for a small world is then written down, to be looked up.
        self.tabulates = isinstance(run.world, TableWorld)

    def init(self) -> tuple[rating_model.Memory, Any]:
        """Return an empty memory and a fresh model."""
        state = jax.eval_shape(self.world.reset, jax.random.key(0))
        state = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), state)
        slots = self.world.slots if self.used else 1
        model = ()
        if self.used and self.spec is not None:
            key, world = key_of(self.seed, MODEL), self.world
            model = rating_model.init(self.spec, key, world.features, world.actions, world.raters)
            model = model, self._table(model)
        return rating_model.memory(slots, state, self.world.raters), model

    def _table(self, model: rating_model.Model) -> Any:
        if not self.tabulates:
            return ()
        assert self.spec is not None
        observations = jax.vmap(self.world.observe)(jnp.arange(self.world.features))
        return rating_model.read(self.spec, model, observations, self.world.actions, self.world.raters)

    def collect(
        self, known: rating_model.Memory, state: Any, action: Array, after: Step, key: Array
    ) -> rating_model.Memory:
        """Put a step to the panel, if it is one that is rated."""
        if not self.used:
            return known
        noise, chance = jax.random.split(key)
        law = self.world.rating_law(state, action, after)
        shape = (*law.centre.shape, UNIFORMS)
        uniform = None if law.quirks is None else jax.random.uniform(jax.random.fold_in(key, 0), shape)
        ratings, mask = answers(law, jax.random.normal(noise, law.centre.shape), uniform)
        visit = aggregate(ratings, after.reward, mask, self.ddof)
        rated = (jax.random.uniform(chance) < self.rated).astype(jnp.float32) * visit.count
        rated = rated if law.reach is None else rated * law.reach
        return rating_model.remember(known, self.world.slot(state, action), state, action, visit, rated)

    def fit(self, known: rating_model.Memory, model: Any, *keys: Array) -> Any:
        """Fit the model to what was collected, once for each key."""
        if not self.used or self.spec is None:
            return model
        spec, world, fitted = self.spec, self.world, model[0]

        def once(fitted: rating_model.Model, key: Array) -> tuple[rating_model.Model, None]:
            if self.tabulates:
                return rating_model.fit_table(spec, fitted, known, world.actions, key), None
            return rating_model.fit(spec, fitted, known, world.observe, world.actions, key), None

        fitted, _ = lax.scan(once, fitted, jnp.stack(keys))
        fitted = rating_model.with_noise(spec, fitted, known, world.observe, world.actions)
        return fitted, self._table(fitted)

    def panel_statistics(self, known: rating_model.Memory, model: Any) -> Any:
        """Return the mitigation's statistics over the distinct state-actions rated so far."""
        if not self.used:
            return self.mitigation.fit(self._nothing((1,)), jnp.zeros(1, bool))
        return self.mitigation.fit(self.of_memory(known, model), known.rows[:, 0] > 0)

    def of_memory(self, known: rating_model.Memory, model: Any) -> Feedback:
        """Return the feedback of every slot's state-action, (M,) arrays; 0 where a model was never told anything."""
        if self.spec is None:
            return from_rows(known.rows)

        def one(slots: Array) -> Feedback:
            states = jax.tree.map(lambda x: x[slots], known.states)
            return self.of(known, model, states, known.actions[slots], from_rows(known.rows[slots]).proxy)

        return rating_model.of_rated(known, one)

    def of(self, known: rating_model.Memory, model: Any, states: Any, actions: Array, reward: Array) -> Feedback:
        """Return the feedback of state-actions with an observed reward, (B,) arrays."""
        if not self.used:
            return self._nothing(actions.shape)
        if self.spec is None:
            return from_rows(known.rows[jax.vmap(self.world.slot)(states, actions)])
        if self.tabulates:
            return rating_model.observing(model[1].map(lambda x: x[states, actions]), reward)
        chosen = jnp.arange(self.world.actions) == actions[:, None]

        def pick(x: Array) -> Array:  # (B, A) or, of each rater, (B, A, K)
            return jnp.where(chosen.reshape(chosen.shape + (1,) * (x.ndim - 2)), x, 0.0).sum(1)

        return rating_model.observing(self.of_all(known, model, states).map(pick), reward)

    def of_all(self, known: rating_model.Memory, model: Any, states: Any) -> Feedback:
        """Return the feedback of all actions in states, (B, A) arrays."""
        actions = self.world.actions
        if not self.used:
            return self._nothing((jax.tree.leaves(states)[0].shape[0], actions))
        if self.spec is None:
            each = jax.vmap(lambda s: jax.vmap(lambda a: self.world.slot(s, a))(jnp.arange(actions)))(states)
            return from_rows(known.rows[each])
        fitted, table = model
        if self.tabulates:
            return table.map(lambda x: x[states])
        observations = jax.vmap(self.world.observe)(states)
        return rating_model.read(self.spec, fitted, observations, actions, self.world.raters)

    def _nothing(self, shape: tuple[int, ...]) -> Feedback:
        return nothing(shape, self.world.raters, jnp, jnp.float32)


def counted(evaluation: HiddenTruth, after: Step) -> Array:
    """Return what a step adds to its episode's row of the log, (len(LOG),)."""
    adds = [evaluation.hack, evaluation.reward, after.reward, evaluation.goal, 1.0, 0.0]
    return jnp.stack([jnp.asarray(x, jnp.float32) for x in adds])


def is_over(world: World, time: Array, after: Step) -> Array:
    """Whether the step taken at ``time`` was its episode's last, by termination or by the horizon."""
    return after.terminated | (time + 1 >= world.horizon)


def goes_on(program: Program, episode: Array, steps: Array, watch: Watch) -> Array:
    """Whether a run has budget left and has not diverged."""
    going = (episode < program.episodes) & (watch.fault == 0)
    return going if program.steps is None else going & (steps < program.steps)


class Watch(NamedTuple):
    """The watch for divergence, and the last state in which all was well: see ``TrainedAgent``."""

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


def finished(
    run: Run, program: Program, source: FeedbackSource, carry: Any, watch: Watch, greedy: Any, read: Any
) -> TrainedAgent:
    """Gather what a run leaves behind; ``greedy`` acts, ``read`` gives mean, deviation and lowest value."""
    world = run.world
    feedback, rated, values = (), (), ()
    if isinstance(world, TableWorld):
        states = jnp.arange(world.features)
        feedback = source.of_all(carry.known, carry.model, states)
        values = read(states)
        rated = carry.known.rows[:, 0]

    def stride(c: tuple[Any, Array], key: Array) -> tuple[tuple[Any, Array], tuple[Array, Array]]:
        state, over = c
        act_key, step_key = jax.random.split(key)
        action = greedy(state, act_key)
        after = world.step(state, action, step_key)
        seen = jnp.where(over, -1, world.slot(state, action)), jnp.where(over, 0.0, after.reward)
        return (after.state, over | after.terminated), seen

    key = jax.random.fold_in(key_of(run.seed, WORLD), LAST)
    times = jnp.arange(program.walk)
    keys = jax.random.split(key, program.walk)

    def timed(c: Any, x: Any) -> Any:
        time, k = x
        (state, over), seen = stride((c[0], c[1] | (time >= world.horizon)), k)
        return (state, over), seen

    _, walk = lax.scan(timed, (world.reset(key), jnp.asarray(False)), (times, keys))
    return TrainedAgent(
        log=carry.log[:-1],  # what came after the last episode that counts was put into the last row
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
