"""What a run says of a policy that is exported: where it came from, how often it succeeds, under which conditions."""

import hashlib
from collections.abc import Callable
from pathlib import Path

from robots.robot import Robot
from tasks.pick import PickTask
from toolkit.bundle.manifest import Held, Lineage, Success
from toolkit.errors import ToolkitError
from toolkit.evaluation.success import evaluate_native
from toolkit.io.jsonfiles import read_object
from toolkit.learning.policy import GaussianPolicy
from toolkit.runs.run import paths_to, read_nodes, read_success

LABEL_EPISODES = 40
"""Played for the label of a policy whose run has not evaluated it."""


def holds_of(folder: Path, policy: Path, target: str, task: str) -> tuple[Held, ...]:
    """The ranges that a stress test found, refused if it was another policy's, robot's or task's."""
    file = folder / "result.json"
    content = read_object(file, "give the folder of a finished stress --out")
    for what, found, wanted in (("policy", content.get("policy"), hashlib.sha256(policy.read_bytes()).hexdigest()),
                                ("target", content.get("target"), target), ("task", content.get("task"), task)):
        if found != wanted:
            raise ToolkitError(f"{file} is of {what} {str(found)[:12]}, but what is exported is {wanted[:12]}; give its own stress test")
    try:
        tried = {name: [row["conditions"][name] for row in content["alone"] if name in row["conditions"]] for name in content["ranges"]}
        return tuple(
            Held(name, found["unit"], found["meaning"], float(found["nominal"]), float(found["low"]), float(found["high"]),
                 float(min([*tried[name], found["nominal"]])), float(max([*tried[name], found["nominal"]])), content["episodes"])
            for name, found in content["ranges"].items()
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ToolkitError(f"{file} is no result of a stress test ({error!r}); give the folder of a finished stress --out") from None


def lineage_of(run: Path, target: str) -> Lineage:
    """The way that a run took to a target.

    Raises:
        ToolkitError: the run has no such target, or its files are damaged.
    """
    tree, report = read_nodes(run), read_success(run)
    alpha = next((node["alpha"] for node in tree["nodes"] if node["name"] == target), None)
    if alpha is None:
        raise ToolkitError(f"{run / 'tree.json'} has no node {target!r}; give the run that was trained for it")
    routes = report.get("routes", {})
    walked = paths_to({path: names for path, names in routes.items() if names}, target)
    route = routes[walked[0]] if walked else [target]
    updates, episodes = (sum(report.get(key, {}).get(path, 0) for path in walked) for key in ("train_iterations", "sim_epochs"))
    return Lineage(
        source=next((node["name"] for node in tree["nodes"] if node["kind"] == "source"), "unknown"), route=tuple(route),
        alpha=tuple(map(float, alpha)), kind=tree["kind"], metric=tree["metric"],
        train_iterations=updates, sim_epochs=episodes,
    )


def label_of(
    run: Path, robot: Robot, task: PickTask, policy: GaussianPolicy,
    progress: Callable[[int, int], None] = lambda done, successes: None,
) -> Success:
    """Success as the run's report has it, or measured now on LABEL_EPISODES episodes.

    Args:
        run: its folder.
        robot, task: the target, and what it does.
        policy: that the run trained for it.
        progress: called with episodes done and successes so far.
    """
    found = read_success(run).get("targets", {}).get(robot.name, {}).get("native")
    measured = "by the run that trained it, through robosuite's own step"
    if found is None:
        found = evaluate_native(policy, robot, task, LABEL_EPISODES, progress=progress).to_json()
        measured = "at export, through robosuite's own step"
    return Success(found["episodes"], found["successes"], float(found["success_rate"]), tuple(map(float, found["ci95"])), found["seed"],
                   measured)
