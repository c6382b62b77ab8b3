"""expert, transfer: the commands that train."""

from pathlib import Path
from typing import Literal

from toolkit.cli.names import TARGETS, TASK, Method, Metric, find_robot, find_task, make_lab
from toolkit.cli.terminal import Progress, emit


def expert(
    source: str = "adroit",
    task: str = TASK,
    out: Path | None = None,
    updates: int = 6,
    demonstrations: int = 160,
    seed: int = 0,
    episodes: int = 200,
    json: bool = False,
) -> None:
    """Train the source expert: scripted demonstrations, behaviour cloning, natural policy gradient.

    Args:
        source: the robot to train on.
        task: what it does.
        out: folder for the policy; default: the package's own experts.
        updates: natural-gradient updates after cloning.
        demonstrations: scripted episodes.
        seed: of everything random.
        episodes: of the final evaluation on the source robot itself, on unseen seeds.
        json: print one JSON object at the end.
    """
    robot = find_robot(source)
    from toolkit.evaluation import evaluate_native
    from toolkit.expert import SHIPPED, ExpertConfig, save_expert, train_expert
    from toolkit.simulation.rollout import RolloutEngine

    lab = make_lab(source, [name for name in TARGETS if name != source], task)
    engine = RolloutEngine(lab.merged)
    config = ExpertConfig(demonstrations=demonstrations, updates=updates, seed=seed)
    with Progress("expert", quiet=json) as progress:
        policy, value, card = train_expert(engine, source, config, progress.expert(config))
        result = evaluate_native(policy, robot, lab.task, episodes, progress=progress.count(f"{source} native", episodes))
    command = f"meta-evolve expert --source {source} --task {task} --updates {updates} --demonstrations {demonstrations} --seed {seed}"
    card |= {"command": command, "evaluation": result.to_json()}
    save_expert(policy, value, out or SHIPPED, f"{source}-{task}", card)
    low, high = result.ci95
    emit(card, json, f"{source}, {task}: {result.successes} of {episodes} on the source robot ({low:.2f} to {high:.2f}); "
                      f"saved in {out or SHIPPED}")  # fmt: skip


def transfer(
    source: str = "adroit",
    targets: tuple[str, ...] = TARGETS,
    task: str = TASK,
    kind: Method = "steiner",
    metric: Metric = "l1",
    step: Literal["adaptive", "fixed"] | None = None,
    path: Literal["straight", "optimised"] = "straight",
    seed: int = 0,
    preset: str = "quick",
    run: Path | None = None,
    resume: bool = False,
    json: bool = False,
) -> None:
    """Transfer the source expert to every target along the evolution tree, then evaluate on the unmodified robots.

    Writes logs/<run>/: config, tree, metrics, checkpoints, recording.rrd, policies, report. Ctrl-C leaves a run that
    --resume continues to the same result.

    Args:
        source: the robot that the expert was trained on.
        targets: where the policy should go.
        task: what it does; "<object>-wide" starts within 5 cm and 30 degrees instead of 1 cm.
        kind: evolution tree: steiner, geometric-median or independent paths; direct trains on the targets without evolution.
        metric: distance between robots.
        step: adaptive (farthest robot on which the policy holds) or fixed (length xi, as in the paper).
        path: straight to the meta robot (REvolveR), or optimised: also where the expected return grows (HERD), at 72 episodes
            a step.
        seed: of everything random.
        preset: quick (minutes), full, or paper (every number from the paper's table).
        run: run folder; default: logs/<source>-<task>-<kind>-<metric>-<preset>-<seed>, with the path if it is not straight.
        resume: continue the run in that folder.
        json: print the report as one JSON object at the end.
    """
    robot, goals, what = find_robot(source), tuple(find_robot(name) for name in targets), find_task(task)
    from toolkit.pipeline import PRESETS, Job, Pipeline, summary, transfer_config

    config = transfer_config(preset, kind, metric, seed, step, path)
    bent = "" if path == "straight" else f"{path}-"
    folder = run or Path("logs") / f"{source}-{task}-{kind}-{metric}-{bent}{preset}-{seed}"
    job = Job(robot, goals, what, config, PRESETS[preset]["evaluation_episodes"])
    with Progress("transfer", quiet=json) as progress:
        pipeline = Pipeline(job, folder, resume, progress.transfer(config))
        report = pipeline.play()
    emit(report, json, summary(report, pipeline.tree) + f"\nRun folder: {folder}; look at it with: meta-evolve view {folder}")
