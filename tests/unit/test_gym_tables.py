"""Any problem of tables as a Gymnasium environment, and the names of all environments."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from uard import InvalidValueError, UnknownNameError
from uard.envs import names
from uard.envs.base import Environment, TableEnvironment
from uard.envs.grids.learned_reward import LearnedRewardGrid
from uard.envs.grids.trapgrid import TrapGrid
from uard.envs.gym import IDS, GridEnv, make
from uard.envs.tables import HiddenTruth, Task
from uard.ratings.panels import MAIN, Panel, Rater

GRID = LearnedRewardGrid(size=6, unrated=2, horizon=60)


@dataclass(frozen=True)
class Corridor(TableEnvironment):
    """Three states, two actions (back, on), three starts; the last state is the goal, and pays 0.1."""

    horizon: int = 4
    states = 3  # type: ignore[assignment]

    def task(self, dtype=np.float32) -> Task:
        next_state = np.array([[0, 1], [0, 2], [1, 2]], np.int32)
        terminal = (next_state == 2) & (np.arange(3) < 2)[:, None]
        return Task(next_state, (0.1 * terminal).astype(dtype), terminal, np.arange(3), np.int32(self.horizon))

    def truth(self, dtype=np.float32) -> HiddenTruth:
        task = self.task(dtype)
        return HiddenTruth(task.reward, np.zeros((3, 2), bool), task.terminal)


def test_any_tables_will_do():
    env = GridEnv(Corridor(), panel="single", render_mode="ansi")
    check_env(env, skip_render_check=True)
    assert (env.observation_space, env.action_space) == (gymnasium.spaces.Discrete(3), gymnasium.spaces.Discrete(2))
    starts = [env.reset(seed=seed)[0] for seed in range(300)]
    counts = np.bincount(starts, minlength=3)
    assert (abs(counts - 100) < 37).all(), "4.5 standard deviations of 300 draws of one in three"
    while env.reset()[0] != 0:
        pass
    assert env.render() == "step 0/4\nstate 0\n"
    assert env.step(1)[:4] == (1, 0.0, False, False)
    assert env.step(1)[:4] == (2, 0.1, True, False), "rewards are exact, not rounded to float32"
    with pytest.raises(InvalidValueError, match=r"^action = 2: must be a whole number in \[0, 1\]$"):
        env.reset() and env.step(2)
    assert GridEnv(Corridor()).metadata["render_modes"] == ["ansi"]


def test_a_learned_reward_says_its_doubt_and_is_rated_where_people_have_been():
    env = GridEnv(GRID, panel=MAIN)
    task, truth, rated = GRID.task(np.float64), GRID.truth(np.float64), GRID.rated()
    state, _ = env.reset(seed=0)
    random, asked, silent = np.random.default_rng(0), 0, 0
    for action in random.integers(4, size=400).tolist():
        after, reward, terminated, truncated, info = env.step(action)
        assert (after, reward, info["doubt"]) == tuple(
            table[state, action] for table in (task.next_state, task.reward, task.doubt)
        )
        assert (info["evaluation"].true_reward, info["evaluation"].hack) == (
            truth.reward[state, action],
            truth.hack[state, action],
        )
        assert info["ratings"].shape == (3,)
        assert np.isnan(info["ratings"]).all() == (not rated[after])
        assert not np.isnan(info["ratings"]).any() or not rated[after]
        asked, silent = asked + rated[after], silent + (not rated[after])
        state = env.reset()[0] if terminated or truncated else after
    assert min(asked, silent) > 20


def test_hacks_of_a_learned_reward_do_not_depend_on_the_precision():
    for seed in range(5):
        grid = LearnedRewardGrid(model_seed=seed)
        np.testing.assert_array_equal(grid.truth().hack, grid.truth(np.float64).hack)
        np.testing.assert_allclose(grid.task().reward, grid.task(np.float64).reward, rtol=1e-6)


def test_a_learned_reward_is_known_to_gymnasium_and_drawn_as_the_grid_that_it_means():
    env = gymnasium.make("uard/LearnedRewardGrid-v0", panel="main", unrated=3)
    assert env.unwrapped.problem == LearnedRewardGrid(unrated=3)  # type: ignore[attr-defined]
    check_env(gymnasium.make("uard/LearnedRewardGrid-v0", render_mode="rgb_array").unwrapped)
    for mode in ("ansi", "rgb_array"):
        mine, meant = GridEnv(GRID, render_mode=mode), GridEnv(GRID.grid(), render_mode=mode)
        pictures = [(e.reset(), e.step(1), e.render())[-1] for e in (mine, meant)]
        np.testing.assert_array_equal(*pictures)


def test_a_rater_who_skips_a_step_is_missing():
    shy = Panel((Rater(noise=0.0), Rater(coverage=0.3)))
    env = GridEnv(TrapGrid(6), panel=shy)
    env.reset(seed=0)
    rows = []
    for _ in range(600):
        *_, terminated, truncated, info = env.step(0)
        rows.append(info["ratings"])
        if terminated or truncated:
            env.reset()
    missing = np.isnan(rows).mean(0)
    assert missing[0] == 0.0
    assert missing[1] == pytest.approx(0.7, abs=4.5 * np.sqrt(0.21 / 600))


def test_every_environment_has_one_name_and_all_but_gymnasiums_own_an_id():
    assert set(names.ENVIRONMENTS) - set(IDS.values()) == {"CartPole", "Acrobot"}
    assert {f"uard/{name}-v0": name for name in IDS.values()} == IDS
    assert len({repr(e) for e in names.ENVIRONMENTS.values()}) == len(names.ENVIRONMENTS) - 1, "TrapGrid is TrapGrid6"
    for environment in names.ENVIRONMENTS.values():
        assert isinstance(environment, Environment)
        assert hash(environment) == hash(environment)


def test_building_by_name_starts_from_the_settings_not_from_what_they_led_to():
    assert names.build("TrapGrid8-Trap8", size=12) == TrapGrid(12, trap_reward=8.0), "its own traps and horizon"
    with pytest.raises(UnknownNameError, match=r"^environment = 'BoatRase': .*did you mean 'BoatRace'"):
        names.build("BoatRase")
    with pytest.raises(UnknownNameError, match=r"^environment = 'CartPole'"):
        make("CartPole")
    with pytest.raises(InvalidValueError, match="'speed': must be one of "):
        make("BoatRace", speed=1)


def test_making_and_diagnosing_grids_needs_no_jax():
    code = (
        "import sys, gymnasium, uard.envs, uard.diagnosis; "
        "from uard.envs.gym import IDS; from uard.envs.names import ENVIRONMENTS; "
        "envs = [gymnasium.make(i, panel='main') for i, n in IDS.items() if ENVIRONMENTS[n].kind != 'simulator']; "
        "[(env.reset(seed=0), env.step(1)) for env in envs]; "
        "assert len(envs) == 19; assert not {'jax', 'torch', 'mujoco'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-W", "error", "-c", code], check=True, timeout=60)
