"""What a bundle says of its task is the task's own, and it is played on no other."""

from dataclasses import replace

import pytest

from tasks import TASKS
from toolkit.bundle.reading import load_bundle, shipped_bundles
from toolkit.errors import ToolkitError
from toolkit.export.packing import check_task, task_card


def test_a_tasks_goal_horizon_and_tolerance_are_its_own(task):
    own = replace(task, goal_offset=(0.1, -0.05, 0.3), goal_tolerance=0.02, hold_steps=3, horizon=70, title="mine")
    card = task_card(own)
    assert (card.name, card.goal_offset_m, card.goal_tolerance_m) == ("mine", (0.1, -0.05, 0.3), 0.02)
    assert (card.hold_steps, card.horizon_steps) == (3, 70)


@pytest.mark.parametrize("name", sorted(shipped_bundles()))
def test_a_shipped_bundles_task_is_the_one_of_its_name(name):
    bundle = load_bundle(name)
    check_task(bundle.manifest, TASKS[bundle.manifest.task.name], bundle.path)


@pytest.mark.parametrize("change, said", [
    ({"goal_offset": (0.0, 0.0, 0.2)}, "goal_offset_m"), ({"horizon": 100}, "horizon_steps"), ({"goal_tolerance": 0.1}, "goal_tolerance_m"),
    ({"control_frequency": 10.0}, "policy_hz"),
])
def test_a_bundle_of_another_task_of_the_same_name_is_refused(change, said):
    """Its label would be compared with what was measured on something else."""
    bundle = load_bundle("kinova3")
    other = replace(TASKS[bundle.manifest.task.name], **change)
    assert other.name == bundle.manifest.task.name
    with pytest.raises(ToolkitError, match=f"{said} is .*, here it is .*"):
        check_task(bundle.manifest, other, bundle.path)
