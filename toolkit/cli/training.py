"""expert, transfer: the commands that train."""

import inspect
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from toolkit.cli.names import TARGETS, TASK, Method, Metric, family_of, find_arm, find_pick, find_robot, find_task, make_lab
from toolkit.cli.terminal import Progress, document, emit
from toolkit.errors import ToolkitError
from toolkit.io.quoting import told

if TYPE_CHECKING:
    from robots.model_robot import ModelRobot
    from robots.robot import Robot
    from tasks.pick import PickTask
    from tasks.task import ModelTask, PractisedTask
    from toolkit.expert.training import ExpertConfig
    from toolkit.inspection.recording.recorder import RunRecorder
    from toolkit.learning.policy import GaussianPolicy, ValueFunction
    from toolkit.runs.run import Run
    from toolkit.simulation.cluster import Cluster
    from toolkit.simulation.rollout import Engine


def expert(
    source: str = "adroit",
    task: str = TASK,
    demos: Path | None = None,
    frame_rate: float = 25.0,
    out: Path | None = None,
    updates: int | None = None,
    demonstrations: int = 160,
    seed: int = 0,
    episodes: int = 200,
    compiled: bool = False,
    run: Path | None = None,
    resume: bool = False,
    cluster: str | None = None,
    json: bool = False,
) -> None:
    """Train the source expert: demonstrations, behaviour cloning, natural policy gradient under the sparse reward.

    Demonstrations are scripted, or with --demos recordings of hands in DexYCB's format, retargeted to the robot's hand; for door,
    hammer and relocate --demos is a file of recorded steps. What was recorded also pulls the policy gradient (DAPG). The ant's expert
    learns from nothing: to run, then to run through the maze (some ten minutes on two free cores). Writes logs/<run>/: config, metrics,
    checkpoints, report. Ctrl-C leaves a run that --resume continues to the same result.

    Args:
        source: the robot to train on.
        task: what it does; an expert for "<object>-wide" serves "<object>" as well and is evaluated on both.
        demos: folder of recordings, as made by `meta-evolve recordings make`, or DexYCB's own; a file of recorded steps, of the format
            in docs/demonstrations.md or hand_dapg's.
        frame_rate: of the recordings [Hz].
        out: folder for the policy; default: the package's own experts.
        updates: natural-gradient updates after cloning; default: 6, and for an expert that learns from nothing what was found to do.
        demonstrations: demonstrated episodes; failed ones are dropped and counted. Of a file, its first so many.
        seed: of everything random.
        episodes: of the final evaluation on the source robot itself, on unseen seeds.
        compiled: evaluate with the compiled control step in place of robosuite's own: the same physics, many times faster.
        run: run folder; default: logs/expert-<source>-<task>-<seed>.
        resume: continue the run in that folder.
        cluster: Ray cluster that plays the episodes, with the same numbers, as in transfer; recordings are retargeted here.
        json: print one JSON object at the end.
    """
    if episodes < 1 or demonstrations < 1 or (updates is not None and updates < 0) or seed < 0:
        raise ToolkitError(f"episodes is {episodes}, demonstrations {demonstrations}, updates {updates} and seed {seed}; give at "
                           "least one episode and one demonstration, updates and seed from 0 on")
    robot, what = find_robot(source), find_task(task)
    from robots.model_robot import ModelRobot
    from tasks.task import ModelTask, PractisedTask
    from toolkit.evaluation.success import evaluate_compiled, evaluate_native
    from toolkit.expert.practice import PracticeConfig
    from toolkit.expert.shelf import POLICY_FILE, RECORDED, SHIPPED, narrow_task, save_expert
    from toolkit.expert.training import ExpertConfig
    from toolkit.morphology.lab import check_players
    from toolkit.runs.run import Run
    from toolkit.simulation.cluster import cluster_at

    check_players([robot], what)
    practised = isinstance(what, PractisedTask)
    if updates is None:
        updates = PracticeConfig.updates if practised else ExpertConfig.updates
    config = ExpertConfig(demonstrations=demonstrations, updates=updates, seed=seed)
    asked = {"source": source, "task": task, "demos": None if demos is None else str(demos), "frame_rate": frame_rate, "seed": seed,
             "updates": updates, "demonstrations": demonstrations}
    folder = run or Path("logs") / f"expert-{source}-{task}-{seed}"
    with Progress("expert", quiet=json) as progress, cluster_at(cluster) as nodes:
        given = None if demos is None else (demos, frame_rate, resume)
        # Before there is a run folder: none for demonstrations that are not there.
        if isinstance(what, PractisedTask) and isinstance(robot, ModelRobot):
            train = _practice_teaches(robot, what, given, config, progress, nodes)
        elif isinstance(what, ModelTask) and isinstance(robot, ModelRobot):
            train = _steps_teach(robot, what, given, config, progress, nodes)
        else:
            train = _hands_teach(find_arm(source), find_pick(task), given, config, progress, nodes)
        kept = Run.open(folder, asked) if resume else Run.create(folder, asked)
        with kept.at_work():
            policy, value, card = train(kept)
            policy.save(folder / f"{source}{POLICY_FILE}")
            evaluated = {"evaluation": what} | ({"narrow": narrow_task(what)} if narrow_task(what) != what else {})
            counter = lambda name: progress.count(f"{source}, unmodified, {name}", episodes)  # noqa: E731
            results = {
                key: evaluate_compiled(policy, robot, t, episodes, cluster=nodes) if compiled
                else evaluate_native(policy, robot, t, episodes, progress=counter(t.name), cluster=nodes)
                for key, t in evaluated.items()
            }
    shown: list[str | Path | int] = [] if demos is None else ["--demos", demos]
    shown += [] if practised else ["--demonstrations", demonstrations]
    command = told("expert", "--source", source, "--task", task, *shown, "--updates", updates, "--seed", seed)
    card |= {"command": command} | {key: result.to_json() for key, result in results.items()}
    kept.write_json("report", card)
    lines = []
    for key, result in results.items():
        low, high = result.ci95
        name = task if key == "evaluation" else narrow_task(what).name
        lines.append(f"{source}, {name}: {result.successes} of {episodes} on the source robot ({low:.2f} to {high:.2f})")
    name = f"{source}-{task}{RECORDED if demos is not None and not isinstance(what, ModelTask) else ''}"
    try:
        save_expert(policy, value, out or SHIPPED, name, card)
        lines.append(f"Saved in {out or SHIPPED}; run folder: {folder}")
    except (OSError, ToolkitError) as error:  # hours of training are not lost with it: --resume with another --out saves them
        emit(card, json, "\n".join([*lines, f"Run folder: {folder}"]))
        raise ToolkitError(f"the expert is trained, but {name} cannot be saved in {out or SHIPPED} ({error}); give another --out, with "
                           "--resume") from None
    emit(card, json, "\n".join(lines))


Learned = tuple["GaussianPolicy", "ValueFunction", dict[str, Any]]
"""The policy, its value function, and what its card says."""
Training = Callable[["Run"], Learned]
"""Trains within a run."""
Shown = tuple[Path, float, bool]
"""Where demonstrations lie, their frame rate [Hz], and whether a run that has looked at them is resumed."""


def _hands_teach(
    robot: "Robot", task: "PickTask", shown: Shown | None, config: "ExpertConfig", progress: Progress, cluster: "Cluster | None"
) -> Training:
    """A pick's expert: taught by a script, or by recordings of hands."""
    from toolkit.demonstrations.replay import Retargeter, teachers_for
    from toolkit.expert.training import train_expert
    from toolkit.simulation.rollout import RolloutEngine

    if shown is not None and not shown[2]:
        Retargeter(shown[0], robot, shown[1])

    def train(run: "Run") -> Learned:
        watch = progress.recordings(task.object.name)
        teachers = None if shown is None else lambda: teachers_for(shown[0], robot, task, shown[1], watch)
        lab = make_lab(robot.name, [name for name in TARGETS if name != robot.name], task.name)
        engine = RolloutEngine(lab.merged) if cluster is None else cluster.merged(lab)
        found = train_expert(engine, robot.name, config, progress.expert(config), teachers, run)
        engine.close()
        return found

    return train


def _steps_teach(
    robot: "ModelRobot", task: "ModelTask", shown: Shown | None, config: "ExpertConfig", progress: Progress, cluster: "Cluster | None"
) -> Training:
    """The expert of a task on one model: taught by recorded steps, on the unmodified robot."""
    from toolkit.demonstrations.reading import read_demonstrations
    from toolkit.expert.training import imitate

    if shown is None:
        raise ToolkitError(f"task {task.name} has no script that could teach; give --demos, a file of recorded steps "
                           "(docs/demonstrations.md)")
    recorded = read_demonstrations(shown[0], task)

    return _on_the_robot(robot, task, cluster, lambda engine, run: imitate(engine, config, recorded, progress.expert(config), run))


def _practice_teaches(
    robot: "ModelRobot", task: "PractisedTask", shown: Shown | None, config: "ExpertConfig", progress: Progress, cluster: "Cluster | None"
) -> Training:
    """The expert of a task that has an easier one: it learns from nothing, on the unmodified robot."""
    from toolkit.expert.practice import PracticeConfig, practise

    if shown is not None:
        raise ToolkitError(f"the expert of task {task.name} learns from nothing; leave out --demos {shown[0]}")
    how = PracticeConfig(updates=config.updates, seed=config.seed)

    return _on_the_robot(robot, task, cluster, lambda engine, run: practise(engine, task, how, progress.expert(how), run))


def _on_the_robot(
    robot: "ModelRobot", task: "ModelTask", cluster: "Cluster | None", learn: Callable[["Engine", "Run"], Learned]
) -> Training:
    """The training that ``learn`` is, on an engine of the unmodified robot, here or on the cluster."""
    from toolkit.simulation.rollout import NativeEngine

    def train(run: "Run") -> Learned:
        engine = NativeEngine(robot, task) if cluster is None else cluster.native(robot, task)
        found = learn(engine, run)
        engine.close()
        return found

    return train


def _said(command: Callable[..., None], values: dict[str, Any], leave_out: Sequence[str]) -> list[str]:
    """The options that a command was given, as words: those whose values are not the default."""
    words = []
    for name, parameter in inspect.signature(command).parameters.items():
        value = values[name]
        if name not in leave_out and value != parameter.default:
            words += [f"--{name.replace('_', '-')}", *map(str, value if isinstance(value, tuple) else (value,))]
    return words


def record_run(*run: Any) -> "RunRecorder":
    """The recording of a run while it goes on, as ``Pipeline`` begins it; an installation without the viewer has none, and says so."""
    from toolkit.inspection.recording.recorder import begin_recording

    return begin_recording(*run)


def transfer(
    source: str = "adroit",
    targets: tuple[str, ...] | None = None,
    task: str = TASK,
    kind: Method = "steiner",
    metric: Metric = "l1",
    step: Literal["adaptive", "fixed"] | None = None,
    path: Literal["straight", "bent", "optimised"] | None = None,
    joints: Literal["measured", "retargeted"] | None = None,
    xi: float | None = None,
    budget: int | None = None,
    expert: str | None = None,
    learner: Literal["search", "npg"] | None = None,
    exploration: float | None = None,
    seed: int = 0,
    preset: str = "quick",
    episodes: int | None = None,
    randomise: Path | None = None,
    run: Path | None = None,
    resume: bool = False,
    cluster: str | None = None,
    at_once: int | None = None,
    json: bool = False,
) -> None:
    """Transfer the source expert to every target along the evolution tree, then evaluate on the unmodified robots.

    First of all the expert plays on every target as it is ("direct, untrained"): where it succeeds, no evolution is needed.

    Writes logs/<run>/: config, tree, metrics, checkpoints, recording.rrd, policies, report. Ctrl-C leaves a run that
    --resume continues to the same result.

    Args:
        source: the robot that the expert was trained on.
        targets: where the policy should go; default: kinova3 and iiwa for the preset quick, else jaco, kinova3 and iiwa; for a task of
            hands or ants, all others of the source's family.
        task: what it does; "<object>-wide" starts within 5 cm and 30 degrees instead of 1 cm; door, hammer and relocate are for --source
            adroit-free, ant-maze is for --source ant.
        kind: evolution tree: steiner, geometric-median or independent paths; asking: the shortest tree, left where a robot reached
            is a better start, as looks tell; direct trains on the targets without evolution.
        metric: distance between robots.
        step: adaptive (farthest robot on which the policy holds) or fixed (length xi, as in the paper).
        path: straight to the meta robot (REvolveR); bent: turned on edges where all parameters at once lead through robots that
            can do less than both ends; or optimised: also where the expected return grows (HERD), at 72 episodes a step;
            default: the preset's, bent for quick and full.
        joints: finger joints as the policy sees them: measured, 0 where a robot has none, as in the paper; or retargeted, where the
            source's would be at that progress of closing; default: the preset's, retargeted for quick and full.
        xi: length of a fixed step, and of the shortest adaptive one; default: the paper's 0.03.
        budget: training episodes after which a path goes on to its end untrained; default: the preset's.
        expert: the source's policy: a shipped expert's name (as adroit-061_foam_brick, which grasps by a script and needs no
            evolution), or the files of your own without their endings; default: the one that learned the task from recordings of hands,
            where there is one, else the shipped one.
        learner: npg (the natural policy gradient on the weights alone, as in the paper), or search: first an offset of what the policy
            sees, held for an episode, and the weights where that brings no more; default: the preset's.
        exploration: standard deviation of the action's noise when the transfer begins; default: the expert's own.
        seed: of everything random.
        preset: quick (minutes), full, or paper (every number from the paper's table).
        episodes: of the final evaluation, per target, on F(beta) and on the unmodified robot; default: the preset's.
        randomise: JSON file of conditions, as stress names them, that every episode of the last hop, to the unmodified robot, draws from
            ranges, such as {"pose_noise": [0, 0.02], "delay": [0, 4]}; the goal is then to be reached under them.
        run: run folder; default: logs/<source>-<task>-<kind>-<metric>-<preset>-<seed>, with path, joints, expert and file of conditions
            where they are not the usual.
        resume: continue the run in that folder.
        cluster: Ray cluster that plays the episodes, with the same numbers: auto for the one that this machine belongs to, or HOST:PORT
            of its head; see docs/cluster.md.
        at_once: paths of the tree that are played side by side, with the same numbers; default: 1, on a cluster as many as targets.
        json: print the report as one JSON object at the end.
    """
    said = _said(transfer, locals(), leave_out=("run", "resume", "json", "cluster", "at_once"))
    robot, what = find_robot(source), find_task(task)
    goals = None if targets is None else tuple(find_robot(name) for name in targets)
    from tasks.task import ModelTask
    from toolkit.expert.shelf import taught_by_hands
    from toolkit.simulation.cluster import cluster_at
    from toolkit.transfer.pipeline import PRESETS, Job, Pipeline, summary, transfer_config

    config = transfer_config(preset, kind, metric, seed, step=step, path=path, joints=joints, xi=xi, path_budget=budget, learner=learner,
                             exploration=exploration)
    for name, value in (("episodes", episodes), ("at_once", at_once)):
        if value is not None and value < 1:
            raise ToolkitError(f"{name} is {value}; give at least 1")
    ways = "".join(f"{option}-" for option in (path, joints) if option is not None)
    taught = "" if expert is None else f"-from-{Path(expert).name}"
    under = "" if randomise is None else f"-under-{randomise.stem}"
    folder = run or Path("logs") / f"{source}-{task}-{kind}-{metric}-{ways}{preset}-{seed}{taught}{under}"
    if goals is None:
        usual = tuple(find_robot(name) for name in PRESETS[preset].get("targets", TARGETS))
        goals = tuple(family_of(what)[1:]) if isinstance(what, ModelTask) else usual
    ranges = None
    if randomise is not None:
        from toolkit.evaluation.randomised import read_ranges

        ranges = read_ranges(randomise)
    job = Job(robot, goals, what, config, episodes or PRESETS[preset]["evaluation_episodes"], expert or taught_by_hands(source, task),
              ranges)
    with Progress("transfer", quiet=json) as progress, cluster_at(cluster) as nodes:
        paths = at_once or (1 if cluster is None else len(goals))
        pipeline = Pipeline(job, folder, resume, progress.transfer(config), record_run, nodes, paths)
        pipeline.run.write_json("command", {"words": ["transfer", *said]})
        report = pipeline.play()
    if json:
        emit(report, True, "")
        return
    document(summary(report, pipeline.tree))
    emit(None, False, f"Run folder: {folder}\nLook at it with: {told('view', folder)}")
