from __future__ import annotations

import math

import numpy as np
import pytest

from uard import InvalidValueError, UnknownNameError
from uard.envs.grids.gym import TrapGridEnv
from uard.envs.grids.trapgrid import TrapGrid
from uard.ratings.panels import PANELS, ratings

GRID = TrapGrid(size=6)
TWIN = TrapGrid(size=6, legitimate=True)
RATERS = {"main": 3, "appendix": 3, "colluding": 3, "single": 1}


def said(panel: str, grid: TrapGrid = GRID, noise: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return what the panel says, and which steps enter a trap."""
    speech = ratings(panel, grid.task(), grid.truth(), noise)
    return speech.centre, speech.deviation, np.asarray(grid.truth().hack)


def test_every_panel_rates_every_step():
    assert set(PANELS) == set(RATERS)
    for panel, raters in RATERS.items():
        centre, deviation, _ = said(panel)
        assert centre.shape == deviation.shape == (36, 4, raters)
        assert centre.dtype == deviation.dtype == np.float32
        assert (deviation >= 0).all()


def test_the_main_panel_says_the_papers_numbers_of_a_trap():
    centre, deviation, trap = said("main")
    np.testing.assert_allclose(centre[trap], [[-1.0, 2.0, 1.0]] * 4, rtol=1e-6)
    np.testing.assert_allclose(deviation[trap], [[0.1, 0.0, 1.0]] * 4, rtol=1e-6)
    assert centre[trap][0].std() == pytest.approx(1.247, abs=5e-4)


@pytest.mark.parametrize(("trap_reward", "tempted", "erratic"), [(4.0, 2.0, 1.0), (8.0, 4.4, 2.6), (-1.0, -1.0, -1.0)])
def test_the_main_panel_stands_between_truth_and_proxy(trap_reward: float, tempted: float, erratic: float):
    centre, _, trap = said("main", TrapGrid(size=6, trap_reward=trap_reward))
    np.testing.assert_allclose(centre[trap], [[-1.0, tempted, erratic]] * 4, rtol=1e-6)


@pytest.mark.parametrize("panel", ["main", "appendix", "single"])
def test_elsewhere_people_tell_the_truth(panel: str):
    centre, _, trap = said(panel)
    truth = np.asarray(GRID.truth().reward)
    np.testing.assert_array_equal(centre[~trap], np.repeat(truth[~trap][:, None], RATERS[panel], axis=1))


@pytest.mark.parametrize(
    ("panel", "at_traps", "elsewhere"),
    [
        ("main", [0.1, 0.0, 1.0], [0.1, 0.1, 0.1]),
        ("appendix", [0.1, 0.3, 1.0], [0.1, 0.3, 0.2]),
        ("colluding", [0.0] * 3, [0.0] * 3),
        ("single", [0.1], [0.1]),
    ],
)
@pytest.mark.parametrize("noise", [0.0, 0.5, 1.2])
def test_deviations_with_noise_in_quadrature(panel: str, at_traps: list, elsewhere: list, noise: float):
    for grid in (GRID, TWIN):
        _, deviation, trap = said(panel, grid, noise)
        for steps, alone in ((trap, at_traps), (~trap, elsewhere)):
            expected = [math.hypot(sd, noise) for sd in alone]
            np.testing.assert_allclose(deviation[steps], [expected] * int(steps.sum()), rtol=1e-6)


@pytest.mark.parametrize("panel", PANELS)
def test_noise_moves_no_centre(panel: str):
    np.testing.assert_array_equal(said(panel)[0], said(panel, noise=2.0)[0])


def test_the_appendix_panel_tells_the_truth_of_a_trap():
    centre, _, trap = said("appendix")
    np.testing.assert_array_equal(centre[trap], np.full((4, 3), -1.0))


@pytest.mark.parametrize("grid", [GRID, TWIN])
def test_the_colluding_panel_repeats_the_proxy(grid: TrapGrid):
    centre, deviation, _ = said("colluding", grid)
    np.testing.assert_array_equal(centre, np.repeat(np.asarray(grid.task().reward)[..., None], 3, axis=-1))
    assert not deviation.any()


@pytest.mark.parametrize("panel", PANELS)
def test_in_the_legitimate_twin_everybody_means_the_bonus(panel: str):
    centre, _, _ = said(panel, TWIN)
    np.testing.assert_allclose(centre, np.repeat(np.asarray(TWIN.task().reward)[..., None], RATERS[panel], axis=-1))


@pytest.mark.parametrize("build", [lambda p, n: said(p, noise=n), lambda p, n: TrapGridEnv(panel=p, noise=n)])
def test_what_makes_no_panel_is_refused_by_name(build):
    with pytest.raises(UnknownNameError, match=r"^panel = 'apendix': must be one of .* \(did you mean 'appendix'\?\)$"):
        build("apendix", 0.0)
    for noise in (-0.1, float("nan"), "much"):
        with pytest.raises(InvalidValueError, match=r"^noise = .*: must be a finite number >= 0$"):
            build("main", noise)


def test_noise_without_a_panel_is_still_checked():
    with pytest.raises(InvalidValueError, match="noise = -1"):
        TrapGridEnv(noise=-1)


@pytest.mark.parametrize("panel", PANELS)
@pytest.mark.parametrize("noise", [0.0, 0.6])
def test_the_environment_draws_these_ratings(panel: str, noise: float):
    """Monte Carlo with a fixed seed, on a step into a wall beside a trap and on one into the trap."""
    visits = 4000
    env = TrapGridEnv(size=3, traps=[[0, 1]], horizon=2 * visits + 1, panel=panel, noise=noise)
    env.reset(seed=1)
    centre, deviation, _ = said(panel, env.grid, noise)
    for state, action in ((0, 0), (0, 3)):
        heard = []
        for _ in range(visits):
            heard.append(env.step(action)[4]["ratings"])
            if action == 3:
                env.step(2)
        drawn = np.array(heard)
        expected, sd = centre[state, action], deviation[state, action]
        assert drawn.shape == (visits, RATERS[panel])
        assert (abs(drawn.mean(0) - expected) <= 4.5 * sd / np.sqrt(visits) + 1e-9).all()
        assert (abs(drawn.std(0) - sd) <= 4.5 * sd / np.sqrt(2 * visits) + 1e-9).all()
        if (sd > 0).all() and len(sd) > 1:
            apart = np.corrcoef(drawn.T)[np.triu_indices(len(sd), 1)]
            assert (abs(apart) < 4.5 / np.sqrt(visits)).all(), "raters are independent"
        env.reset()


def test_without_a_panel_nobody_rates():
    env = TrapGridEnv()
    env.reset(seed=0)
    assert "ratings" not in env.step(1)[4]
