"""Names become records: the only lookups of robots and tasks."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from toolkit.errors import ToolkitError
from toolkit.io.jsonfiles import require

if TYPE_CHECKING:
    from robots.model_robot import ModelRobot
    from robots.robot import Robot
    from tasks.pick import PickTask
    from tasks.task import ModelTask, Task
    from toolkit.bundle.reading import Bundle
    from toolkit.learning.policy import GaussianPolicy
    from toolkit.morphology.build import MergedRobot
    from toolkit.morphology.lab import Lab, Merged, System

Kind = Literal["steiner", "geometric-median", "independent"]
Method = Kind | Literal["asking", "direct"]
Metric = Literal["l1", "l2"]
TARGETS = ("jaco", "kinova3", "iiwa")
TASK = "061_foam_brick"


def all_robots() -> dict[str, "Robot"]:
    """Every system whose card loads, by name.

    Raises:
        ToolkitError: robosuite, or a package that all cards need, does not load.
    """
    try:
        from robots import ROBOTS
    except ImportError as error:
        raise ToolkitError(f"the robots do not load ({' '.join(str(error).split())}); see: meta-evolve doctor") from error
    return ROBOTS


def broken_cards() -> list[str]:
    """A sentence for each card that does not load, those before which others cannot first."""
    from grippers.cards import BROKEN

    where = {module: "tasks/" if module.startswith("tasks/") else "robots/ or grippers/" for module in BROKEN}
    return [f"a card in {where[module]} does not load: {why} ({module}); mend or remove it" for module, why in BROKEN.items()]


def find_robot(name: str) -> "System":
    """The card of a system, or a sentence listing those that exist."""
    arms = all_robots()
    from robots import MODEL_ROBOTS

    known: dict[str, System] = {**arms, **MODEL_ROBOTS}
    if name not in known:
        more = "".join(f"; {broken}" for broken in broken_cards())
        raise ToolkitError(f"robot {name!r} is unknown; there are: {', '.join(known)}{more}")
    return known[name]


def find_task(name: str) -> "Task":
    """A task, or a sentence listing those that exist."""
    from tasks import MODEL_TASKS, TASKS

    known: dict[str, Task] = {**TASKS, **MODEL_TASKS}
    if name not in known:
        more = "".join(f"; {broken}" for broken in broken_cards())
        raise ToolkitError(f"task {name!r} is unknown; there are: {', '.join(known)}{more}")
    return known[name]


def find_pick(name: str) -> "PickTask":
    """A pick by an arm with a gripper, for what only such a task has: an object, recordings of hands, a bundle for a real arm."""
    from tasks.pick import PickTask

    task = find_task(name)
    if not isinstance(task, PickTask):
        raise ToolkitError(f"task {name!r} is no pick by an arm with a gripper, which this command is for")
    return task


def find_arm(name: str) -> "Robot":
    """An arm with a gripper, for what only such a robot has: robosuite's models, a bundle for a real arm."""
    from robots.robot import Robot

    robot = find_robot(name)
    if not isinstance(robot, Robot):
        raise ToolkitError(f"robot {name!r} is no arm with a gripper, which this command is for; there are: {', '.join(all_robots())}")
    return robot


def merged_arms(merged: "Merged") -> "MergedRobot":
    """The merged robot of arms with grippers, for what only such robots have."""
    from toolkit.morphology.build import MergedRobot

    if not isinstance(merged, MergedRobot):
        raise ToolkitError(f"task {merged.task.name!r} is played by robots without arms and grippers, which this command is for")
    return merged


def family_of(task: "ModelTask") -> "list[ModelRobot]":
    """Every robot that plays a task on one model, the source first."""
    from robots import MODEL_ROBOTS

    return [robot for robot in MODEL_ROBOTS.values() if robot.family.name == task.family]


def bundle_roles(name: str) -> tuple["Bundle", "Robot", "PickTask"]:
    """A bundle by its folder, .zip or shipped name, with the robot and the task that it is for.

    Raises:
        ToolkitError: there is none, or it is for other records or another task than are here.
    """
    from toolkit.bundle.reading import load_bundle

    bundle = load_bundle(name)
    manifest = bundle.manifest
    robot, task = find_arm(manifest.robot.name), find_pick(manifest.task.name)
    from toolkit.export.packing import check_records, check_task

    check_records(manifest, bundle.path)
    check_task(manifest, task, bundle.path)
    return bundle, robot, task


def make_lab(source: str, targets: Sequence[str], task: str) -> "Lab":
    """Source, targets and task by their names, merged on first use."""
    systems = [find_robot(name) for name in (source, *targets)]
    from toolkit.morphology.lab import Lab

    return Lab(systems[0], systems[1:], find_task(task))


def transfer_config(folder: Path) -> dict:
    """Config of a transfer's run folder; it names its source, targets and task."""
    from toolkit.runs.run import Run

    content = Run.open(folder).config
    missing = [key for key in ("source", "targets", "task") if key not in content]
    if missing:
        raise ToolkitError(f"{folder / 'config.json'} has no {missing[0]!r}, so it is no transfer's run folder")
    require(content, {"source": str, "targets": [str], "task": str}, str(folder / "config.json"), "start the run again under another --run")
    odd = [name for name in (content["source"], *content["targets"]) if not name.replace("-", "_").isidentifier()]
    if odd or not content["targets"]:
        raise ToolkitError(f"{folder / 'config.json'} names robots {odd or 'none'}, which are no names of robots, so it is damaged")
    return content


def trained_policies(folder: Path, target: str | None) -> tuple[dict, dict[str, "GaussianPolicy"], list[str]]:
    """Config of a run folder, its policies by target, and a sentence for each that cannot be had.

    Raises:
        ToolkitError: there is none.
    """
    from toolkit.expert.shelf import POLICY_FILE
    from toolkit.learning.policy import GaussianPolicy
    from toolkit.runs.run import continuing

    content = transfer_config(folder)
    what = find_task(content["task"])
    found = {}
    trouble = []
    for name in content["targets"] if target is None else [target]:
        if name not in content["targets"]:
            raise ToolkitError(f"target {name!r} is not in {folder}; it has: {', '.join(content['targets'])}")
        file = folder / f"{name}{POLICY_FILE}"
        try:
            if not file.is_file():
                raise ToolkitError(
                    f"{folder} has no policy for {name!r} yet; finish it with: {continuing(folder)}"
                )
            found[name] = GaussianPolicy.load(file, what.observation.names, what.action.names)
        except ToolkitError as error:
            trouble.append(str(error))
    if not found:
        raise ToolkitError(trouble[0])
    return content, found, trouble


def expert_policy(run: str, target: str | None) -> tuple[dict, dict[str, "GaussianPolicy"], list[str]] | None:
    """As trained_policies, of a shipped expert or an expert's run folder; None if it is neither."""
    from robots import MODEL_ROBOTS
    from tasks.task import ModelTask
    from toolkit.expert.shelf import POLICY_FILE, SHIPPED, shipped_experts, shipped_pair
    from toolkit.learning.policy import GaussianPolicy
    from toolkit.runs.run import Run

    if run in shipped_experts():
        source, task = shipped_pair(run, MODEL_ROBOTS)
        file = SHIPPED / f"{run}{POLICY_FILE}"
    else:
        content = Run.open(Path(run)).config
        if "demos" not in content:
            return None
        require(content, {"source": str, "task": str}, str(Path(run) / "config.json"), "start the run again under another --run")
        source, task = content["source"], content["task"]
        file = Path(run) / f"{source}{POLICY_FILE}"
        if not file.is_file():
            raise ToolkitError(f"{run} has no policy yet; finish it with its own command and --resume")
    if target not in (None, source):
        raise ToolkitError(f"target {target!r} is not in {run}; it has: {source}")
    what = find_task(task)
    policy = GaussianPolicy.load(file, what.observation.names, what.action.names)
    others = [robot.name for robot in family_of(what)] if isinstance(what, ModelTask) else TARGETS
    return {"source": source, "targets": [name for name in others if name != source], "task": task}, {source: policy}, []
