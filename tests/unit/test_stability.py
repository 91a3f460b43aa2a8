import numpy as np
import pytest

from uard._checks import UnknownNameError
from uard.method.stability import DEFINITIONS, perturbed_advantage, sign_preservation_radius

WEIGHT = 0.445


@pytest.mark.parametrize("advantage", [10.0, -10.0])
@pytest.mark.parametrize(
    ("definition", "radius", "plain"),
    [("before", 10.0, 10.0), ("after", 4.45, 10.0), ("towards-uncertain", 22.4719, 10.0)],
)
def test_three_radii_disagree_about_who_is_more_robust(advantage, definition, radius, plain):
    assert sign_preservation_radius(advantage, WEIGHT, definition) == pytest.approx(radius, abs=1e-4)
    assert sign_preservation_radius(advantage, definition=definition) == plain


def test_the_trusted_action_has_its_own_weight():
    assert sign_preservation_radius(2.0, 0.25, "towards-uncertain", other_weight=0.5) == 4.0


@pytest.mark.parametrize("definition", DEFINITIONS)
def test_the_radius_is_where_the_perturbed_advantage_changes_sign(definition):
    radius = sign_preservation_radius(3.0, WEIGHT, definition, 0.8)
    around = radius * np.array([0.0, 0.999, 1.0, 1.001])
    after = perturbed_advantage(3.0, around, WEIGHT, definition, 0.8)
    assert np.sign(np.round(after, 12)).tolist() == [1, 1, 0, -1]


@pytest.mark.parametrize("definition", DEFINITIONS)
@pytest.mark.parametrize("function", [sign_preservation_radius, perturbed_advantage])
def test_every_array_library_gives_the_same(backend, definition, function):
    def run(advantage, weight):
        if function is perturbed_advantage:
            return function(advantage, 0.5, weight, definition)
        return function(advantage, weight, definition)

    backend.agrees(run, np.array([3.0, -2.0, 0.0]), np.array([1.0, 0.445, 0.1]))


@pytest.mark.parametrize("function", [sign_preservation_radius, perturbed_advantage])
def test_an_unknown_definition_names_the_nearest(function):
    with pytest.raises(UnknownNameError, match=r"^definition = 'befor': .*\(did you mean 'before'\?\)$"):
        function(1.0, 1.0, definition="befor")
