"""How simulated raters answer: the four named panels by hand, and each way in which a rater can err."""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from uard import InvalidValueError, UnknownNameError
from uard.envs.grids.trapgrid import TrapGrid
from uard.envs.gym import GridEnv, make
from uard.ratings.panels import (
    APPENDIX,
    COLLUDING,
    MAIN,
    PANELS,
    SINGLE,
    UNIFORMS,
    Panel,
    Rater,
    RatingLaw,
    answers,
    as_panel,
    draw,
    random_panel,
)

GRID = TrapGrid(size=6)
TWIN = TrapGrid(size=6, legitimate=True)
RATERS = {"main": 3, "appendix": 3, "colluding": 3, "single": 1}
NUMBERS = st.floats(-1e6, 1e6, allow_subnormal=False)


def law_of(panel: Panel, grid: TrapGrid = GRID, noise: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return centre and deviation of every step's ratings, and which steps enter a trap."""
    law = grid.rating_law(panel, noise)
    assert law.reach is None
    assert law.quirks is None
    return np.asarray(law.centre), np.asarray(law.deviation), np.asarray(grid.truth().hack)


def one_step(rater: Rater, proxy: float = 4.0, true: float = -1.0, contested: bool = True, **panel: Any) -> RatingLaw:
    return Panel((rater,), **panel).law(np.array(proxy), np.array(true), np.array(contested))


def drawn(rater: Rater, count: int = 20_000, **step: Any) -> np.ndarray:
    """Return many answers about one step, (count,)."""
    law, random = one_step(rater, **step), np.random.default_rng(0)
    return np.array([draw(law, random)[0] for _ in range(count)])


# The four named panels


def test_every_panel_rates_every_step():
    assert set(PANELS) == set(RATERS)
    assert tuple(PANELS.values()) == (MAIN, APPENDIX, COLLUDING, SINGLE)
    for name, raters in RATERS.items():
        centre, deviation, _ = law_of(PANELS[name])
        assert centre.shape == deviation.shape == (36, 4, raters)
        assert centre.dtype == deviation.dtype == np.float32
        assert (deviation >= 0).all()


def test_the_main_panel_says_the_papers_numbers_of_a_trap():
    centre, deviation, trap = law_of(MAIN)
    np.testing.assert_allclose(centre[trap], [[-1.0, 2.0, 1.0]] * 4, rtol=1e-6)
    np.testing.assert_allclose(deviation[trap], [[0.1, 0.0, 1.0]] * 4, rtol=1e-6)
    assert centre[trap][0].std() == pytest.approx(1.247, abs=5e-4)


@pytest.mark.parametrize(("trap_reward", "tempted", "erratic"), [(4.0, 2.0, 1.0), (8.0, 4.4, 2.6), (-1.0, -1.0, -1.0)])
def test_the_main_panel_stands_between_truth_and_proxy(trap_reward: float, tempted: float, erratic: float):
    centre, _, trap = law_of(MAIN, TrapGrid(size=6, trap_reward=trap_reward))
    np.testing.assert_allclose(centre[trap], [[-1.0, tempted, erratic]] * 4, rtol=1e-6)


@pytest.mark.parametrize("panel", [MAIN, APPENDIX, SINGLE], ids=["main", "appendix", "single"])
def test_elsewhere_people_tell_the_truth(panel: Panel):
    centre, _, trap = law_of(panel)
    truth = np.asarray(GRID.truth().reward)
    np.testing.assert_array_equal(centre[~trap], np.repeat(truth[~trap][:, None], len(panel.raters), axis=1))


@pytest.mark.parametrize(
    ("panel", "at_traps", "elsewhere"),
    [
        (MAIN, [0.1, 0.0, 1.0], [0.1, 0.1, 0.1]),
        (APPENDIX, [0.1, 0.3, 1.0], [0.1, 0.3, 0.2]),
        (COLLUDING, [0.0] * 3, [0.0] * 3),
        (SINGLE, [0.1], [0.1]),
    ],
)
@pytest.mark.parametrize("noise", [0.0, 0.5, 1.2])
def test_deviations_with_noise_in_quadrature(panel: Panel, at_traps: list, elsewhere: list, noise: float):
    for grid in (GRID, TWIN):
        _, deviation, trap = law_of(panel, grid, noise)
        for steps, alone in ((trap, at_traps), (~trap, elsewhere)):
            expected = [math.hypot(sd, noise) for sd in alone]
            np.testing.assert_allclose(deviation[steps], [expected] * int(steps.sum()), rtol=1e-6)


@pytest.mark.parametrize("panel", PANELS.values(), ids=PANELS)
def test_noise_moves_no_centre(panel: Panel):
    np.testing.assert_array_equal(law_of(panel)[0], law_of(panel, noise=2.0)[0])


def test_the_appendix_panel_tells_the_truth_of_a_trap():
    centre, _, trap = law_of(APPENDIX)
    np.testing.assert_array_equal(centre[trap], np.full((4, 3), -1.0))


@pytest.mark.parametrize("grid", [GRID, TWIN])
def test_the_colluding_panel_repeats_the_proxy(grid: TrapGrid):
    centre, deviation, _ = law_of(COLLUDING, grid)
    np.testing.assert_array_equal(centre, np.repeat(np.asarray(grid.task().reward)[..., None], 3, axis=-1))
    assert not deviation.any()


@pytest.mark.parametrize("panel", PANELS.values(), ids=PANELS)
def test_in_the_legitimate_twin_everybody_means_the_bonus(panel: Panel):
    centre, _, _ = law_of(panel, TWIN)
    np.testing.assert_allclose(centre, np.repeat(np.asarray(TWIN.task().reward)[..., None], len(panel.raters), axis=-1))


# One rater


@given(NUMBERS, NUMBERS)
def test_full_temptation_repeats_the_proxy_and_none_the_truth_to_the_bit(proxy: float, true: float):
    for temptation, expected in ((1.0, proxy), (0.0, true)):
        law = one_step(Rater(temptation=temptation, noise=0.0), proxy, true)
        assert draw(law, np.random.default_rng(0)) == [expected]


@given(st.floats(0, 1), NUMBERS, NUMBERS)
def test_a_tempted_rater_stands_between_truth_and_proxy(temptation: float, proxy: float, true: float):
    centre = float(one_step(Rater(temptation=temptation), proxy, true).centre[0])
    slack = 1e-9 * (1 + abs(proxy) + abs(true))
    assert min(proxy, true) - slack <= centre <= max(proxy, true) + slack


def test_scale_comes_before_bias():
    law = one_step(Rater(temptation=0.5, scale=3.0, bias=-2.0))
    assert law.centre.tolist() == [3.0 * 1.5 - 2.0]


def test_contested_noise_is_that_of_contested_steps():
    rater = Rater(noise=0.3, contested_noise=0.7)
    assert one_step(rater, contested=True).deviation[0] == pytest.approx(0.7)
    assert one_step(rater, contested=False).deviation[0] == pytest.approx(0.3)


def test_a_lapse_is_uniform_over_the_range_and_as_frequent_as_said():
    said = drawn(Rater(noise=0.0, lapse=0.2), low=-3.0, high=7.0)
    lapsed = said[said != -1.0]
    assert len(lapsed) / len(said) == pytest.approx(0.2, abs=4.5 * math.sqrt(0.16 / len(said)))
    width = 10.0 / math.sqrt(12)
    assert lapsed.mean() == pytest.approx(2.0, abs=4.5 * width / math.sqrt(len(lapsed)))
    assert lapsed.std() == pytest.approx(width, rel=0.05)
    assert (lapsed.min() >= -3.0, lapsed.max() < 7.0) == (True, True)


def test_coverage_is_the_share_of_steps_that_are_answered():
    said = drawn(Rater(noise=0.0, coverage=0.35))
    assert (~np.isnan(said)).mean() == pytest.approx(0.35, abs=4.5 * math.sqrt(0.35 * 0.65 / len(said)))
    assert set(said[~np.isnan(said)]) == {-1.0}


@pytest.mark.parametrize(
    ("true", "level"), [(-9.0, -2.0), (-1.4, -2.0), (-0.9, 0.0), (0.9, 0.0), (3.1, 4.0), (9.0, 4.0)]
)
def test_stars_are_levels_evenly_spaced_over_the_range(true: float, level: float):
    """Four stars over -2 .. 4 are -2, 0, 2, 4."""
    assert drawn(Rater(noise=0.0, stars=4), 3, true=true, low=-2.0, high=4.0).tolist() == [level] * 3


def test_noisy_stars_are_still_levels():
    assert set(drawn(Rater(noise=5.0, stars=4), 500, low=-2.0, high=4.0)) == {-2.0, 0.0, 2.0, 4.0}


def test_raters_with_and_without_quirks_sit_in_one_panel():
    panel = Panel((Rater(noise=0.0), Rater(noise=0.0, coverage=0.5), Rater(noise=5.0, stars=2)), low=0.0, high=1.0)
    law, random = panel.law(np.full(4000, 4.0), np.full(4000, 0.3), np.zeros(4000, bool)), np.random.default_rng(0)
    plain, shy, stars = draw(law, random).T
    assert (plain == 0.3).all()
    assert np.isnan(shy).mean() == pytest.approx(0.5, abs=0.04)
    assert set(stars) == {0.0, 1.0}


def test_nobody_answers_where_a_panel_does_not_reach():
    law = MAIN.law(np.zeros(4), np.zeros(4), np.zeros(4, bool))._replace(reach=np.array([1.0, 0.0, 1.0, 0.0]))
    assert np.isnan(draw(law, np.random.default_rng(0))).tolist() == [[False] * 3, [True] * 3] * 2


# Arrays


@pytest.mark.parametrize("panel", PANELS.values(), ids=PANELS)
@pytest.mark.parametrize("shape", [(), (5,), (2, 3)])
def test_panels_speak_of_arrays_of_either_kind_and_any_shape(panel: Panel, shape: tuple):
    random = np.random.default_rng(0)
    step = random.normal(size=shape), random.normal(size=shape), random.random(shape) < 0.5
    step = tuple(np.asarray(x) for x in step)
    law = panel.law(*step, np.float64(0.3))
    assert law.centre.shape == law.deviation.shape == (*shape, len(panel.raters))
    proxy, true, contested = (jnp.asarray(x, bool if x.dtype == bool else jnp.float32) for x in step)
    for call in (panel.law, jax.jit(panel.law)):
        compiled = call(proxy, true, contested, jnp.float32(0.3))
        assert compiled.reach is None
        for got, expected in zip(compiled[:2], law[:2], strict=True):
            assert got.dtype == jnp.float32
            np.testing.assert_allclose(got, expected, rtol=2e-6, atol=1e-6)


def test_compiled_answers_are_those_of_numpy():
    panel = Panel((Rater(lapse=0.3), Rater(coverage=0.4), Rater(stars=5), Rater()), low=-2.0, high=6.0)
    random = np.random.default_rng(0)
    proxy, true = (random.normal(size=200).astype(np.float32) for _ in range(2))
    normal, uniform = random.normal(size=(200, 4)).astype(np.float32), random.random((200, 4, UNIFORMS), np.float32)
    contested = random.random(200) < 0.5

    def answer(xp: Any) -> Any:
        law = panel.law(*(xp.asarray(x) for x in (proxy, true, contested)), xp.float32(0.0))
        return answers(law, xp.asarray(normal), xp.asarray(uniform))

    (ratings, mask), (expected, exists) = jax.jit(lambda: answer(jnp))(), answer(np)
    np.testing.assert_allclose(ratings, expected, rtol=1e-5, atol=1e-5)
    np.testing.assert_array_equal(mask, exists)
    assert 0.3 < exists[:, 1].mean() < 0.5
    assert exists[:, [0, 2, 3]].all()


@pytest.mark.parametrize("panel", PANELS.values(), ids=PANELS)
@pytest.mark.parametrize("noise", [0.0, 0.6])
def test_the_environment_draws_these_ratings(panel: Panel, noise: float):
    """Monte Carlo with a fixed seed, on a step into a wall beside a trap and on one into the trap."""
    visits = 4000
    grid = TrapGrid(size=3, traps=((0, 1),), horizon=2 * visits + 1)
    env = GridEnv(grid, panel=panel, noise=noise)
    env.reset(seed=1)
    centre, deviation, _ = law_of(panel, grid, noise)
    for state, action in ((0, 0), (0, 3)):
        ratings = []
        for _ in range(visits):
            ratings.append(env.step(action)[4]["ratings"])
            if action == 3:
                env.step(2)
        said = np.array(ratings)
        expected, sd = centre[state, action], deviation[state, action]
        assert said.shape == (visits, len(panel.raters))
        assert (abs(said.mean(0) - expected) <= 4.5 * sd / np.sqrt(visits) + 1e-9).all()
        assert (abs(said.std(0) - sd) <= 4.5 * sd / np.sqrt(2 * visits) + 1e-9).all()
        if (sd > 0).all() and len(sd) > 1:
            apart = np.corrcoef(said.T)[np.triu_indices(len(sd), 1)]
            assert (abs(apart) < 4.5 / np.sqrt(visits)).all(), "raters are independent"
        env.reset()


def test_without_a_panel_nobody_rates():
    env = GridEnv(GRID)
    env.reset(seed=0)
    assert "ratings" not in env.step(1)[4]


# Bad input


@pytest.mark.parametrize(
    ("field", "bad"),
    [
        ("temptation", (-0.1, 1.1, math.nan, "much")),
        ("bias", (math.inf, None)),
        ("scale", (0.0, math.inf)),
        ("outliers", (-0.1, 1.5)),
        ("veto_above", (math.nan, "goal")),
        ("veto", (-1.0, math.inf)),
        ("noise", (-0.1, math.nan)),
        ("contested_noise", (-0.1, "some")),
        ("lapse", (-0.1, 1.5)),
        ("coverage", (0.0, 1.1)),
        ("stars", (1, 2.0, True)),
    ],
)
def test_what_makes_no_rater_is_refused_by_name(field: str, bad: tuple):
    for value in bad:
        with pytest.raises(InvalidValueError, match=rf"^{field} = "):
            Rater(**{field: value})


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: Panel(()), r"^raters = \(\): must be a tuple of one Rater or more$"),
        (lambda: Panel([Rater()]), r"^raters = .*: must be a tuple"),  # type: ignore[arg-type]
        (lambda: Panel((Rater(), "main")), r"^raters\[1\] = 'main': must be a Rater$"),  # type: ignore[arg-type]
        (lambda: Panel((Rater(lapse=0.1),)), r"^low = None: must be given with high"),
        (lambda: Panel((Rater(stars=5),), low=1.0), r"^low = 1.0: must be given with high"),
        (lambda: Panel((Rater(),), low=1.0, high=1.0), r"^high = 1.0: must be a finite number > 1$"),
        (lambda: Panel((Rater(),), low=math.nan, high=1.0), r"^low = nan"),
    ],
)
def test_what_makes_no_panel_is_refused_by_name(build: Any, message: str):
    with pytest.raises(InvalidValueError, match=message):
        build()


@pytest.mark.parametrize("build", [as_panel, lambda name: make("TrapGrid", panel=name)])
def test_an_unknown_name_is_refused_with_the_nearest(build: Any):
    with pytest.raises(UnknownNameError, match=r"^panel = 'apendix': must be one of .* \(did you mean 'appendix'\?\)$"):
        build("apendix")


@pytest.mark.parametrize("build", [lambda n: law_of(MAIN, noise=n), lambda n: make("TrapGrid", noise=n)])
def test_bad_noise_is_refused_by_name_with_and_without_a_panel(build: Any):
    for noise in (-0.1, float("nan"), "much"):
        with pytest.raises(InvalidValueError, match=r"^noise = .*: must be a finite number >= 0$"):
            build(noise)


def test_names():
    assert all(as_panel(name) is panel for name, panel in PANELS.items())
    mine = Panel((Rater(bias=1.0),))
    assert as_panel(mine) is mine
    assert str(mine) == "1 rater: noise 0.1, bias 1"
    assert str(MAIN).startswith("3 raters: noise 0.1; noise 0.1, 0 on contested steps, temptation 0.6; ")


@pytest.mark.parametrize("ends", [{"low": float("nan")}, {"low": "x"}, {"high": float("nan")}])
def test_an_end_of_the_range_alone_is_checked_too(ends):
    with pytest.raises(InvalidValueError, match=f"^{next(iter(ends))} = "):
        Panel((Rater(),), **ends)


def test_outliers_are_six_times_as_far_and_as_frequent_as_said():
    plain, heavy = (Panel((Rater(noise=0.5, outliers=x, coverage=1.0),) * 2) for x in (0.0, 0.25))
    shape = (20_000,)
    far = []
    for panel in (plain, heavy):
        law = panel.law(np.zeros(shape), np.zeros(shape), np.zeros(shape, bool))
        far.append(np.abs(draw(law, np.random.default_rng(0))))
    assert far[0].max() < 3.0  # six deviations
    beyond = (far[1] > 3.0).mean()  # one deviation of an outlier
    assert beyond == pytest.approx(0.25 * 0.3173, abs=0.006)  # four standard errors


def test_a_contrary_rater_says_the_opposite():
    assert Rater(scale=-1.0).centre(proxy=4.0, true=10.0) == -10.0


def test_random_panels_are_what_they_are_said_to_be():
    panels = [random_panel(seed) for seed in range(600)]
    sizes = np.bincount([len(p.raters) for p in panels], minlength=8)[1:]
    assert sizes.min() > 60  # 86 on average, nine deviations of four
    for panel in panels:
        useless = sum(r.temptation == 1 or r.lapse == 1 for r in panel.raters)
        assert panel.raters[0].temptation == 0
        assert panel.raters[0].lapse == 0
        assert useless == 0 or 2 * useless < len(panel.raters)
    others = [r for p in panels for r in p.raters[1:]]
    assert np.mean([0 < r.temptation < 1 for r in others]) == pytest.approx(1 / 6, abs=0.04)
    assert all(0.1 <= r.noise <= 2.5 for r in others)
    assert np.mean([p.raters[0].stars == 7 for p in panels]) == pytest.approx(0.25, abs=0.07)


def test_a_random_panel_has_a_name_on_the_command_line():
    assert as_panel("random:12") == random_panel(12) != random_panel(13)
    for bad in ("random:", "random:-1", "random:x", "random:1.5"):
        with pytest.raises(InvalidValueError, match="panel"):
            as_panel(bad)


def test_a_veto_is_said_of_what_is_worth_more():
    law = Panel((Rater(), Rater(veto_above=5.0, veto=-3.0))).law(
        np.array([4.0, 10.0]), np.array([-1.0, 10.0]), np.zeros(2, bool)
    )
    assert law.centre.tolist() == [[-1.0, -1.0], [10.0, -3.0]]
