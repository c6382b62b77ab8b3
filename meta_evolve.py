"""meta-evolve from Python: one expert policy moved to many robots. A worked example is docs/python.md.

    robots, tasks      what there is, by name
    match              robots merged in one evolution space: theta, alpha, F(alpha)
    tree               the evolution tree from the source to the targets
    transfer           the run that moves the policy along it, into a run folder
    load_policy        what a run, or an expert, has learned
    evaluate           success on the unmodified robosuite robot
    export             a bundle: ONNX, units, limits, proof
    make_env           the unmodified robosuite robot as a Gymnasium environment; also gymnasium.make("meta_evolve/Pick-v0", robot=...)

Robots and tasks are given by name, or as cards of one's own (``robots.robot.Robot``, ``tasks.pick.PickTask``, ...). Bad input is a
``ToolkitError`` of one sentence. Nothing heavy is loaded before it is asked for, and nothing is printed.

``evaluate`` and ``transfer`` play in processes of their own: a script calls them under ``if __name__ == "__main__":``.
"""

import sys
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

_HERE = Path(__file__).parent


def _make_way() -> None:
    """See to it that ``toolkit`` is the package beside this file, here and in the processes that will be started.

    Those get this one's ``sys.path`` before they load anything of ours, so that a file or a folder of that name in front of us is
    passed by putting this folder first; where there is none, the path stays as it is.
    """
    ours = (_HERE / "toolkit").resolve()
    there = sys.modules.get("toolkit")
    spec = find_spec("toolkit") if there is None else there.__spec__
    places = (spec and spec.submodule_search_locations) or ()
    if any(Path(place).resolve() == ours for place in places):
        return
    if there is not None:
        file = getattr(there, "__file__", None) or "a folder toolkit"
        raise ImportError(f"{file} was imported as toolkit, the name of a package of meta-evolve; rename that file")
    sys.path.insert(0, str(_HERE))


_make_way()

from toolkit import __version__  # noqa: E402
from toolkit.errors import ToolkitError  # noqa: E402
from toolkit.quiet import silence_robosuite  # noqa: E402

if TYPE_CHECKING:
    import gymnasium

    from robots.robot import Robot
    from tasks.task import Task
    from toolkit.bundle.manifest import Manifest
    from toolkit.cli.names import Kind, Method, Metric
    from toolkit.evaluation.success import Evaluation
    from toolkit.evolution import EvolutionTree
    from toolkit.learning.policy import GaussianPolicy
    from toolkit.morphology.lab import Lab, System

__all__ = ["ToolkitError", "__version__", "evaluate", "export", "load_policy", "make_env", "match", "robots", "tasks", "transfer", "tree"]
SOURCE, TARGETS, TASK = "adroit", ("jaco", "kinova3", "iiwa"), "061_foam_brick"
ENVIRONMENT = "meta_evolve/Pick-v0"
"""Name of the environment that importing this module registers with Gymnasium; its arguments are those of ``make_env``."""

silence_robosuite()


def robots() -> "dict[str, System]":
    """Every robot by name: arms with grippers, then the families of other models, the sources first."""
    from toolkit.cli.names import all_robots

    arms = all_robots()
    from robots import MODEL_ROBOTS

    return {**arms, **MODEL_ROBOTS}


def tasks() -> "dict[str, Task]":
    """Every task by name."""
    from tasks import MODEL_TASKS, TASKS

    return {**TASKS, **MODEL_TASKS}


def match(
    source: "str | System" = SOURCE, targets: "Sequence[str | System]" = TARGETS, task: "str | Task" = TASK
) -> "Lab":
    """Merge robots: the laboratory with their evolution space (``space``) and F (``merged``).

    Args:
        source: the robot that the expert was trained on.
        targets: where its policy should go.
        task: what they do.

    Raises:
        ToolkitError: an unknown name, a robot named twice, or a card or model with which something is wrong.
    """
    from toolkit.morphology.lab import Lab

    return Lab(_robot(source), [_robot(name) for name in targets], _task(task))


def tree(
    source: "str | System" = SOURCE,
    targets: "Sequence[str | System]" = TARGETS,
    metric: "Metric" = "l1",
    kind: "Kind" = "steiner",
    effort: float = 1.0,
    task: "str | Task" = TASK,
) -> "EvolutionTree":
    """The evolution tree from the source to the targets.

    Args:
        source, targets: as for ``match``.
        metric: "l1" or "l2".
        kind: "steiner", "geometric-median" or "independent".
        effort: how long to search and prove.
        task: what they do; robots other than arms with grippers are compared in their task's scene.

    Raises:
        ToolkitError: as ``match``.
    """
    from toolkit.evolution import evolution_tree
    from toolkit.morphology.lab import check_players, check_roles
    from toolkit.morphology.survey import as_points

    systems, what = [_robot(name) for name in (source, *targets)], _task(task)
    check_roles(systems[0], systems[1:])
    check_players(systems, what)
    start, *goals = as_points(systems, what)
    return evolution_tree(start, goals, metric, kind, effort)


def transfer(
    run: str | Path,
    source: "str | System" = SOURCE,
    targets: "Sequence[str | System] | None" = None,
    task: "str | Task" = TASK,
    *,
    kind: "Method" = "steiner",
    metric: "Metric" = "l1",
    preset: str = "quick",
    seed: int = 0,
    expert: str | None = None,
    episodes: int | None = None,
    resume: bool = False,
    watch: Callable[[dict[str, Any]], None] = lambda record: None,
    record: bool = True,
    cluster: str | None = None,
    at_once: int = 1,
    **schedule: Any,
) -> dict[str, Any]:
    """Transfer the source's expert to every target, and evaluate it on the unmodified robots; the same as ``meta-evolve transfer``.

    Args:
        run: the run folder: config, tree, metrics, checkpoints, policies, report.
        source: the robot that the expert was trained on.
        targets: where its policy should go; None: the preset's.
        task: what they do.
        kind: "steiner", "geometric-median", "independent", "asking" or "direct".
        metric: "l1" or "l2".
        preset: "quick", "full" or "paper".
        seed: of everything random.
        expert: a shipped expert's name, or files of one's own without their endings; None: the one that learned from recordings.
        episodes: of the final evaluation, per target; None: the preset's.
        resume: continue the run that is in the folder.
        watch: called with every event, a dictionary with the key "event".
        record: write recording.rrd for the viewer.
        cluster: Ray cluster that plays the episodes, "auto" or HOST:PORT of its head; None: this machine. The numbers are the same.
        at_once: paths of the tree that are played side by side. The numbers are the same.
        schedule: fields of ``toolkit.transfer.settings.TransferConfig`` that override the preset's.

    Returns:
        the report, as in report.json.

    Raises:
        ToolkitError: bad input, or a folder that holds another run.
    """
    from toolkit.cli.training import record_run
    from toolkit.expert.shelf import taught_by_hands
    from toolkit.simulation.cluster import cluster_at
    from toolkit.transfer.pipeline import PRESETS, Job, Pipeline, transfer_config

    config = transfer_config(preset, kind, metric, seed, **schedule)
    start, what = _robot(source), _task(task)
    goals = tuple(_robot(name) for name in (PRESETS[preset].get("targets", TARGETS) if targets is None else targets))
    job = Job(start, goals, what, config, PRESETS[preset]["evaluation_episodes"] if episodes is None else episodes,
              expert or taught_by_hands(start.name, what.name))
    with cluster_at(cluster) as nodes:
        return Pipeline(job, Path(run), resume, watch, record_run if record else None, nodes, at_once).play()


def load_policy(run: str | Path, target: str | None = None) -> "GaussianPolicy":
    """A policy: ``mean(observation)`` is its action.

    Args:
        run: a run folder, or the name of an expert that comes with the package.
        target: which robot of the run; may be left out where there is only one.

    Raises:
        ToolkitError: there is no such run, robot or policy.
    """
    from toolkit.cli.names import expert_policy, trained_policies

    _, found, _ = expert_policy(str(run), target) or trained_policies(Path(run), target)
    if len(found) > 1:
        raise ToolkitError(f"{run} has policies for {', '.join(found)}; name one as the target")
    return next(iter(found.values()))


def evaluate(
    policy: "GaussianPolicy | str | Path",
    robot: "str | System | None" = None,
    task: "str | Task | None" = None,
    episodes: int = 100,
    seed: int = 0,
    processes: int | None = None,
) -> "Evaluation":
    """Success on the unmodified robosuite robot, through robosuite's own step, on seeds that training never saw.

    Args:
        policy: as of ``load_policy``; or a bundle (folder, .zip or the name of a shipped one), whose ONNX graph then plays alone.
        robot: who plays; a bundle names it itself.
        task: what is played; None: 061_foam_brick, or the bundle's.
        episodes: how many.
        seed: shifts the seeds.
        processes: None: one per core. With 1 it needs no ``if __name__ == "__main__":``.

    Raises:
        ToolkitError: bad input, or a bundle for other robots or another task than are here.
    """
    from toolkit.cli.names import bundle_roles
    from toolkit.evaluation.success import evaluate_native

    if episodes < 1 or seed < 0:
        raise ToolkitError(f"episodes is {episodes} and seed {seed}; give at least one episode and a seed from 0 on")
    if not isinstance(policy, str | Path):
        if robot is None:
            raise ToolkitError("evaluate was given a policy but no robot; name the robot that shall play it")
        return evaluate_native(policy, _robot(robot), _task(task or TASK), episodes, seed, processes)
    if robot is not None or task is not None:
        raise ToolkitError(f"robot and task are written in bundle {policy}; leave them out")
    bundle, player, what = bundle_roles(str(policy))
    return evaluate_native(bundle.path, player, what, episodes, seed, processes)


def export(run: str | Path, target: str, out: str | Path) -> "Manifest":
    """Write a run's policy for a target as a bundle, a folder and a .zip beside it; the same as ``meta-evolve export``.

    Args:
        run: the run folder.
        target: which robot of the run.
        out: folder of the bundle; made if needed.

    Returns:
        what the bundle's manifest.json says.

    Raises:
        ToolkitError: the run has no such policy, or the folder holds something else.
    """
    from toolkit.cli.names import find_arm, find_pick, trained_policies
    from toolkit.export.labels import label_of, lineage_of
    from toolkit.export.packing import write_bundle

    content, policies, _ = trained_policies(Path(run), target)
    policy, robot, task = policies[target], find_arm(target), find_pick(content["task"])
    lineage = lineage_of(Path(run), target)  # before the label's episodes: a damaged run is told of at once
    return write_bundle(policy, robot, task, content, lineage, label_of(Path(run), robot, task, policy), Path(out))


def make_env(robot: "str | System" = "kinova3", task: "str | Task" = TASK, render_mode: str | None = None) -> "gymnasium.Env":
    """The unmodified robot in its task as a Gymnasium environment, with the named observation and action records.

    robosuite's arms are stepped by robosuite, robots of other families by their own environment.

    Args:
        robot, task: who does what.
        render_mode: "rgb_array" or None.

    Raises:
        ToolkitError: an unknown name, or a card or model with which something is wrong.
    """
    from robots.model_robot import ModelRobot
    from tasks.task import ModelTask
    from toolkit.morphology.lab import check_players

    player, what = _robot(robot), _task(task)
    check_players([player], what)
    if isinstance(what, ModelTask) and isinstance(player, ModelRobot):
        if render_mode is not None:
            raise ToolkitError(f"task {what.name!r} has no pictures here; leave render_mode={render_mode!r} out")
        return what.environment(player)
    from tasks.pick import PickTask
    from toolkit.simulation.environment import NativeEnv

    if not isinstance(what, PickTask):
        raise ToolkitError(f"task {what.name!r} is neither a pick nor on a model of its own, so there is no environment for it")
    return NativeEnv(_arm(player), what, render_mode)


def _robot(which: "str | System") -> "System":
    from toolkit.cli.names import find_robot

    return find_robot(which) if isinstance(which, str) else which


def _arm(which: "str | System") -> "Robot":
    from toolkit.cli.names import find_arm

    if isinstance(which, str):
        return find_arm(which)
    from robots.robot import Robot

    if not isinstance(which, Robot):
        raise ToolkitError(f"robot {which.name!r} is no arm with a gripper; give its task as well: match(source, targets, task).tree()")
    return which


def _task(which: "str | Task") -> "Task":
    from toolkit.cli.names import find_task

    return find_task(which) if isinstance(which, str) else which


def _register() -> None:
    import gymnasium

    if ENVIRONMENT not in gymnasium.registry:
        gymnasium.register(ENVIRONMENT, entry_point="meta_evolve:make_env")


if __name__ == "__main__":
    from toolkit.cli import main

    main()
else:
    _register()
