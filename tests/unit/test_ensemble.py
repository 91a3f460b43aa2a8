import gymnasium
import numpy as np
import pytest

from uard import InvalidValueError
from uard.adapters.reward_ensemble import RewardEnsemble

BOX = gymnasium.spaces.Box(-1.0, 1.0, (2,))
FOUR = gymnasium.spaces.Discrete(4)


def test_members_agree_where_they_saw_much_and_not_elsewhere():
    ensemble = RewardEnsemble(BOX, BOX, seed=1)
    random = np.random.default_rng(0)
    near, actions = random.uniform(-1, -0.4, (400, 2)), random.uniform(-1, 1, (400, 2))
    ensemble.update(near, actions, near.sum(1))
    far = -near
    assert ensemble(near, actions).mean() < 0.25 * ensemble(far, actions).mean()
    assert np.abs(ensemble.predict(near, actions).mean(0) - near.sum(1)).mean() < 0.1


def test_numbered_states_are_told_apart():
    ensemble = RewardEnsemble(gymnasium.spaces.Discrete(10, start=5), FOUR)
    states, actions = np.full(200, 7), np.zeros(200, int)
    ensemble.update(states, actions, np.full(200, 2.0))
    assert ensemble.predict([7], [0]).mean() == pytest.approx(2.0, abs=0.1)
    assert ensemble([7], [0]) < 0.2 < ensemble([9], [3])


def test_it_learns_from_single_steps_as_from_batches_of_them():
    one, many = RewardEnsemble(BOX, FOUR, seed=4), RewardEnsemble(BOX, FOUR, seed=4)
    random = np.random.default_rng(0)
    states, actions, rewards = random.uniform(-1, 1, (256, 2)), random.integers(0, 4, 256), random.normal(size=256)
    for i in range(256):
        one.update(states[i : i + 1], actions[i : i + 1], rewards[i : i + 1])
    for i in range(0, 256, 64):
        many.update(states[i : i + 64], actions[i : i + 64], rewards[i : i + 64])
    # Their bootstraps differ, what they learned does not by much.
    gap = np.abs(one.predict(states, actions).mean(0) - many.predict(states, actions).mean(0)).mean()
    assert gap < 0.5 * np.abs(rewards).mean()


def test_spaces_within_spaces():
    space = gymnasium.spaces.Dict({"where": BOX, "what": gymnasium.spaces.MultiBinary(3)})
    ensemble = RewardEnsemble(space, FOUR)
    batch = {"where": np.zeros((5, 2), np.float32), "what": np.ones((5, 3), np.int8)}
    ensemble.update(batch, np.zeros(5, int), np.ones(5))
    assert ensemble(batch, np.zeros(5, int)).shape == (5,)


def test_the_same_seed_twice():
    a, b = (RewardEnsemble(BOX, BOX, seed=2) for _ in range(2))
    for e in (a, b):
        e.update(np.ones((3, 2)), np.ones((3, 2)), np.ones(3))
    assert np.array_equal(a(np.zeros((1, 2)), np.zeros((1, 2))), b(np.zeros((1, 2)), np.zeros((1, 2))))


@pytest.mark.parametrize("bad", [{"members": 1}, {"features": 0}, {"ridge": 0.0}, {"prior_scale": -1.0}])
def test_bad_options(bad):
    with pytest.raises(InvalidValueError, match=f"{next(iter(bad))} = "):
        RewardEnsemble(BOX, BOX, **bad)
