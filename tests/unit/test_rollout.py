import gymnasium
import numpy as np
import pytest

from uard import InvalidValueError
from uard.ratings.rollout import rollout


class Gives(gymnasium.Env):
    observation_space = action_space = gymnasium.spaces.Discrete(2)

    def __init__(self, reward=1.0, ratings=(1.0, 2.0)):
        self.reward, self.ratings = reward, ratings

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return 0, {}

    def step(self, action):
        return 1, self.reward, False, False, {"ratings": self.ratings}


@pytest.mark.parametrize("reward", [None, "3", [1.0], np.ones(2), 1j], ids=str)
def test_a_reward_that_is_no_number_is_named_with_its_row(reward):
    with pytest.raises(InvalidValueError, match=r"^rollout: row 1, column 'reward' = .*: must be one number$"):
        rollout(Gives(reward), 2)


def test_none_is_a_missing_rating():
    assert np.isnan(rollout(Gives(ratings=[1.0, None]), 2).ratings).tolist() == [[False, True]] * 2


@pytest.mark.parametrize("ratings", [{1: 2.0}, "123", {1.0}, ["1"], [1j]], ids=str)
def test_ratings_that_are_no_row_of_numbers_are_named(ratings):
    with pytest.raises(InvalidValueError, match="ratings"):
        rollout(Gives(ratings=ratings), 2)
