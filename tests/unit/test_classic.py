from __future__ import annotations

import math
import subprocess
import sys
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from uard import InvalidValueError
from uard.envs.classic.specs import Acrobot, CartPole
from uard.envs.world import World
from uard.ratings.panels import MAIN, PANELS

KEY = jax.random.key(0)
SPECS = {"CartPole-v1": CartPole, "Acrobot-v1": Acrobot}


def visited(name: str, episodes: int, steps: int) -> np.ndarray:
    """Return the (n, 4) states that a random agent meets in Gymnasium's environment."""
    env, random = gymnasium.make(name).unwrapped, np.random.default_rng(1)
    states = []
    for episode in range(episodes):
        env.reset(seed=episode)
        for _ in range(steps):
            states.append(env.state)  # type: ignore[attr-defined]
            if env.step(int(random.integers(env.action_space.n)))[2]:  # type: ignore[attr-defined]
                break
    return np.asarray(states, np.float32)


def anywhere(name: str, count: int) -> np.ndarray:
    """Return states all over the space, beyond the ends and at the top speeds too."""
    width = [2.6, 3.0, 0.25, 3.0] if name == "CartPole-v1" else [math.pi, math.pi, 4 * math.pi, 9 * math.pi]
    return (np.random.default_rng(2).uniform(-1, 1, (count, 4)) * width).astype(np.float32)


def theirs(name: str, states: np.ndarray, actions: np.ndarray) -> tuple[np.ndarray, ...]:
    """Step Gymnasium's own environment once from each state."""
    env = gymnasium.make(name).unwrapped
    env.reset(seed=0)
    rows = []
    for state, action in zip(states.astype(float), actions.tolist(), strict=True):
        env.state, env.steps_beyond_terminated = state, None  # type: ignore[attr-defined]
        rows.append(env.step(action)[:3])
    return tuple(np.array(column) for column in zip(*rows, strict=True))


@jax.jit
def ours(world: Any, states: jax.Array, actions: jax.Array) -> tuple[jax.Array, ...]:
    after = jax.vmap(lambda s, a: world.step(s, a, KEY))(states, actions)
    return jax.vmap(world.observe)(after.state), after.reward, after.terminated, after.doubt


@pytest.mark.parametrize("name", SPECS)
@pytest.mark.parametrize("where", ["visited", "anywhere"])
def test_each_step_is_gymnasiums(name: str, where: str):
    states = visited(name, 12, 60) if where == "visited" else anywhere(name, 400)
    world = SPECS[name]().world(MAIN)
    actions = np.random.default_rng(3).integers(world.actions, size=len(states))
    assert len(states) >= 200
    observation, reward, terminated = theirs(name, states, actions)
    seen, got, ended, doubt = ours(world, states, actions)
    assert seen.dtype == got.dtype == doubt.dtype == jnp.float32
    # At an acrobot's top speeds, 9 pi, one step multiplies the rounding of float32.
    np.testing.assert_allclose(seen, observation, rtol=1e-4, atol=2e-5 if where == "visited" else 3e-4)
    np.testing.assert_array_equal(ended, terminated)
    np.testing.assert_array_equal(got, reward)
    assert where == "visited" or 0 < terminated.sum() < len(states)
    assert not np.asarray(doubt).any()


@pytest.mark.parametrize("name", SPECS)
def test_a_whole_episode_is_gymnasiums(name: str):
    """While the errors are still small: forty steps of either."""
    env, world = gymnasium.make(name).unwrapped, SPECS[name]().world(MAIN)
    env.reset(seed=4)
    state = jnp.asarray(env.state, jnp.float32)  # type: ignore[attr-defined]
    step = jax.jit(lambda w, s, a: w.step(s, a, KEY))
    for time in range(40):
        action = time % 2 if name == "CartPole-v1" else 2 * (time // 5 % 2)
        observation, reward, terminated, *_ = env.step(action)
        after = step(world, state, action)
        state = after.state
        np.testing.assert_allclose(world.observe(state), observation, rtol=1e-3, atol=1e-4)
        assert (float(after.reward), bool(after.terminated)) == (reward, terminated)
        if terminated:
            break


@pytest.mark.parametrize("state", [(2.41, 0, 0, 0), (-2.41, 0, 0, 0), (0, 0, 0.21, 0), (0, 0, -0.21, 0)])
def test_a_cart_ends_beyond_the_track_or_with_a_fallen_pole(state: tuple):
    after = CartPole().world(MAIN).step(jnp.array(state, jnp.float32), jnp.int32(0), KEY)
    assert bool(after.terminated)
    assert float(after.reward) == 1.0, "the terminating step is paid too"


def test_an_acrobot_turns_round_and_has_top_speeds():
    world = Acrobot().world(MAIN)
    state = jnp.array([3.0, -3.0, 12.5, -28.2], jnp.float32)
    angles, speeds = np.split(np.asarray(world.step(state, jnp.int32(1), KEY).state), 2)
    assert (abs(angles) <= math.pi + 1e-6).all()
    assert (abs(speeds) <= np.float32([4 * math.pi, 9 * math.pi])).all()
    resting = world.step(jnp.zeros(4), jnp.int32(1), KEY)
    np.testing.assert_array_equal(resting.state, 0.0)
    np.testing.assert_array_equal(world.observe(resting.state), [1, 0, 1, 0, 0, 0])


def test_an_acrobot_at_the_top_is_paid_nothing_for_it():
    world = Acrobot().world(MAIN)
    after = world.step(jnp.array([math.pi, 0, 0, 0], jnp.float32), jnp.int32(1), KEY)
    verdict = world.evaluate(jnp.zeros(4), jnp.int32(1), after)
    assert (float(after.reward), bool(after.terminated), bool(verdict.goal)) == (0.0, True, True)


@pytest.mark.parametrize(("spec", "width"), [(CartPole(), 0.05), (Acrobot(), 0.1)])
def test_starts_are_uniform(spec: CartPole | Acrobot, width: float):
    starts = np.asarray(jax.vmap(spec.world(MAIN).reset)(jax.random.split(KEY, 4000)))
    assert (abs(starts) <= width).all()
    np.testing.assert_allclose(starts.mean(0), 0.0, atol=width / 20)
    np.testing.assert_allclose(starts.std(0), width / math.sqrt(3), rtol=0.05)


@pytest.mark.parametrize("name", SPECS)
@pytest.mark.parametrize("panel", PANELS)
def test_there_is_no_lie(name: str, panel: str):
    world = SPECS[name]().world(PANELS[panel], 0.3)
    state = world.reset(KEY)
    after = world.step(state, jnp.int32(0), KEY)
    truth, law = world.evaluate(state, jnp.int32(0), after), world.rating_law(state, jnp.int32(0), after)
    assert (truth.reward, bool(truth.hack), bool(truth.goal)) == (after.reward, False, False)
    assert law.centre.shape == law.deviation.shape == (world.raters,)
    assert law.centre.dtype == law.deviation.dtype == jnp.float32
    np.testing.assert_array_equal(law.centre, np.full(world.raters, after.reward))
    alone = SPECS[name]().world(PANELS[panel]).rating_law(state, jnp.int32(0), after).deviation
    np.testing.assert_allclose(law.deviation, np.hypot(alone, 0.3), rtol=1e-6)


@pytest.mark.parametrize(("name", "actions", "features"), [("CartPole-v1", 2, 4), ("Acrobot-v1", 3, 6)])
def test_what_they_are_made_of(name: str, actions: int, features: int):
    spec, theirs = SPECS[name](), gymnasium.make(name)
    world = spec.world(PANELS["appendix"])
    assert isinstance(world, World)
    assert (world.actions, world.features, world.raters, world.slots) == (actions, features, 3, 1)
    assert spec.horizon == world.horizon == theirs.spec.max_episode_steps == 500  # type: ignore[union-attr]
    assert theirs.observation_space.shape == (features,)
    assert int(world.slot(world.reset(KEY), jnp.int32(1))) == 0
    assert SPECS[name](horizon=7).world(MAIN).horizon == 7


@pytest.mark.parametrize("spec", SPECS.values())
@pytest.mark.parametrize("horizon", [0, 2.0, True, "500", None, 100_001])
def test_bad_horizons_are_refused_by_name(spec: Any, horizon: object):
    with pytest.raises(InvalidValueError, match=r"^horizon = .*: must be a whole number in \[1, 100000\]$"):
        spec(horizon=horizon)


@pytest.mark.parametrize("spec", SPECS.values())
@pytest.mark.parametrize("noise", [-0.1, math.nan, "much", None])
def test_bad_noise_is_refused_by_name(spec: Any, noise: Any):
    with pytest.raises(InvalidValueError, match=r"^noise = .*: must be a finite number >= 0$"):
        spec().world(MAIN, noise=noise)


def test_configurations_need_no_jax():
    code = (
        "import sys; from uard.envs.names import ENVIRONMENTS; "
        "[e.task() for e in ENVIRONMENTS.values() if e.kind == 'tables']; "
        "assert not {'jax', 'torch', 'mujoco'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-W", "error", "-c", code], check=True, timeout=60)
