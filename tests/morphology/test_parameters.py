"""Named parameters of a few robots of numbers alone, against interpolation between them."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from toolkit.errors import ToolkitError
from toolkit.morphology.parameters import Field, ParameterSpace

LENGTHS = np.array([[[1.0, 0.2], [4.0, 0.2]], [[3.0, 0.2], [2.0, 0.2]], [[2.0, 0.2], [3.0, 0.2]]])
"""Three robots, two links, (length, radius): the first grows as the second shrinks, and no radius differs."""


def field(values, name="size", elements=("arm", "arm"), unit="m"):
    values = np.asarray(values, float)
    return Field(name, tuple(f"link{row}" for row in range(values.shape[1])), elements, ("length", "radius"), unit, values)


@pytest.fixture
def space():
    values = np.array([[[5.0], [10.0]], [[15.0], [30.0]], [[10.0], [20.0]]])
    gain = Field("gain", ("link0", "link1"), ("arm", "hand"), ("",), "N m/rad", values)
    return ParameterSpace(["a", "b", "c"], [field(LENGTHS), gain], lambda f, row: f"{f.unit}/{row}")


def test_only_what_differs_is_a_parameter_and_says_what_it_is(space):
    told = {(p.name, p.unit, p.element, p.low, p.high, p.flipped) for p in space.parameters}
    assert told == {("link0.size.length", "m/0", "arm", 1.0, 3.0, False), ("link1.size.length", "m/1", "arm", 2.0, 4.0, True),
                    ("link0.gain", "N m/rad/0", "arm", 5.0, 15.0, False), ("link1.gain", "N m/rad/1", "hand", 10.0, 30.0, False)}
    assert space.describe()[0]["values"] == {"a": 1.0, "b": 3.0, "c": 2.0}


def test_what_moves_together_within_an_element_is_one_dimension(space):
    """Both lengths and a gain of the arm, rising or falling; the hand's gain, which rises as they do, is another element's."""
    dimension = {p.name: p.dimension for p in space.parameters}
    assert dimension["link0.size.length"] == dimension["link1.size.length"] == dimension["link0.gain"] != dimension["link1.gain"]
    assert space.size == 2 and space.betas.tolist() == [[0, 0], [1, 1], [0.5, 0.5]], "the source stands at zero"


tables = st.integers(2, 4).flatmap(lambda robots: st.lists(
    st.lists(st.integers(-4, 4), min_size=robots, max_size=robots), min_size=1, max_size=6))


@given(columns=tables, share=st.floats(0.0, 1.0), data=st.data())
def test_theta_goes_straight_from_robot_to_robot(columns, share, data):
    """At each robot's alpha stand its own numbers, and between two, in every entry, the share of the way between theirs."""
    values = np.array(columns, float).T[:, :, None]
    assume(np.ptp(values, axis=0).any())
    elements = tuple(data.draw(st.sampled_from(("arm", "hand"))) for _ in columns)
    items = tuple(f"item{k}" for k in range(len(columns)))
    space = ParameterSpace([f"r{k}" for k in range(len(values))], [Field("length", items, elements, ("",), "m", values)])
    for name, own in zip(space.names, values, strict=True):
        np.testing.assert_allclose(space.theta(space.beta(name))["length"], own, atol=1e-12)
    middle = (1 - share) * space.betas[0] + share * space.betas[-1]
    np.testing.assert_allclose(space.theta(middle)["length"], (1 - share) * values[0] + share * values[-1], atol=1e-12)
    for p in space.parameters:
        assert p.low == p.values.min() < p.values.max() == p.high
    together = {}
    for p in space.parameters:
        together.setdefault(p.dimension, set()).add(p.element)
    assert sorted(together) == list(range(space.size)) and all(len(found) == 1 for found in together.values())


def test_robots_that_do_not_differ_are_refused():
    with pytest.raises(ToolkitError, match="robots a, b do not differ in any parameter"):
        ParameterSpace(["a", "b"], [field(LENGTHS[[0, 0]])])


@pytest.mark.parametrize("alpha, said", [
    ([0.5], r"alpha has shape \(1,\); this evolution space has 2 dimensions"), ([0.5, 1.5], r"alpha\[1\] = 1.5 lies outside"),
    ([np.nan, 2.0], r"alpha\[0\] = nan lies outside"), ([-1e-9, 0.5], r"alpha\[0\] = -1e-09 lies outside"),
])
def test_what_is_no_point_of_the_space_is_named(space, alpha, said):
    with pytest.raises(ToolkitError, match=said):
        space.theta(np.array(alpha))
    with pytest.raises(ToolkitError, match="robot 'd' is not in this evolution space; it has a, b, c"):
        space.beta("d")
