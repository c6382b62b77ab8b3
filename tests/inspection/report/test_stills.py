"""Stills: one robot turning into another, with its object and goal where they are."""

import numpy as np
import pytest

from toolkit.errors import ToolkitError
from toolkit.inspection.report import stills
from toolkit.inspection.visual import visual_of


def test_stills_show_one_robot_turning_into_another(small):
    try:
        renderer = stills.ArmRenderer(visual_of(small.merged), (96, 96))
    except ToolkitError as error:
        pytest.skip(str(error))
    source, target = small.space.betas
    pictures = [renderer.take(source + share * (target - source)).astype(float) for share in (0.0, 0.5, 1.0)]
    again = renderer.take(source).astype(float)
    renderer.close()
    np.testing.assert_array_equal(again, pictures[0])
    apart = [np.abs(a - b).mean() for a, b in ((pictures[0], pictures[2]), (pictures[0], pictures[1]), (pictures[1], pictures[2]))]
    assert apart[0] > apart[1] > 0.5 and apart[0] > apart[2] > 0.5, f"halfway lies between the ends: {apart}"


def test_the_goal_and_the_object_are_drawn_where_they_are(small):
    try:
        renderer = stills.ArmRenderer(visual_of(small.merged), (96, 96))
    except ToolkitError as error:
        pytest.skip(str(error))
    nobody = (np.zeros((len(renderer.instances), 3)), np.tile((1.0, 0, 0, 0), (len(renderer.instances), 1)))
    draw = lambda **more: renderer.draw(*nobody, np.zeros(2), **more).astype(int)  # noqa: E731
    empty, high = draw(), draw(carried=np.array([-0.1, 0.0, 1.1, 1, 0, 0, 0]))
    goal = draw(goal=np.array([-0.1, 0.0, 1.1]))
    renderer.close()
    red = lambda picture: np.argwhere(picture[..., 0] > picture[..., 1] + 80).mean(axis=0)  # noqa: E731
    assert red(high)[0] < red(empty)[0] - 10, "the brick is lifted"
    green = np.argwhere(np.abs(goal - empty).sum(axis=-1) > 30)
    assert len(green) > 20 and np.abs(green.mean(axis=0) - red(high)).max() < 4, "the goal is where the brick was held"


@pytest.mark.parametrize("near", [True, False])
def test_pictures_of_a_robot_that_turns(crawlers, near):
    try:
        renderer = stills.renderer_of(visual_of(crawlers.merged), (96, 96), near)
    except ToolkitError as error:
        pytest.skip(str(error))
    source, target = crawlers.space.betas[:2]
    pictures = [renderer.take(source + share * (target - source)).astype(float) for share in (0.0, 0.5, 1.0)]
    again = renderer.take(source).astype(float)
    renderer.close()
    np.testing.assert_array_equal(again, pictures[0])
    apart = [np.abs(a - b).mean() for a, b in ((pictures[0], pictures[2]), (pictures[0], pictures[1]))]
    assert apart[0] > apart[1] > 0.3, f"halfway lies between the ends: {apart}"
