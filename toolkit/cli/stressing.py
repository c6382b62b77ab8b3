"""stress: under which conditions a policy holds."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from toolkit.cli.judging import is_bundle
from toolkit.cli.names import bundle_roles, find_arm, find_pick, trained_policies
from toolkit.cli.terminal import Progress, emit, room_for, table
from toolkit.errors import ToolkitError

if TYPE_CHECKING:
    from robots.robot import Robot
    from tasks.pick import PickTask
    from toolkit.evaluation.stress import Tried
    from toolkit.learning.policy import GaussianPolicy


def stress(
    policy: Annotated[str, tyro.conf.Positional],
    target: str | None = None,
    episodes: int = 20,
    conditions: tuple[str, ...] = (),
    pairs: int = 20,
    out: Path | None = None,
    plot: Path | None = None,
    workers: int | None = None,
    json: bool = False,
) -> None:
    """Play the unmodified robot under laboratory conditions, each alone and in random pairs: where does the policy hold?

    Mass, friction and size of the object, noise, bias and turn of where it is seen, delay, start posture, table height, goal, stiffness
    and rate of the controller, payload, gravity compensation. The range of a condition is where at least 0.9 of the episodes succeed;
    pairs are drawn within the ranges. With --out a test that was stopped goes on where it was.

    Args:
        policy: folder, .zip or name of a bundle, or a run folder.
        target: which target of a run.
        episodes: of each value and each pair, on the same seeds as evaluate.
        conditions: which; default: all.
        pairs: random pairs of conditions.
        out: folder for episodes.jsonl and result.json.
        plot: file for a picture.
        workers: processes; default: the machine's cores.
        json: print one JSON object.
    """
    if episodes < 1 or pairs < 0 or (workers is not None and workers < 1):
        raise ToolkitError(f"episodes is {episodes}, pairs {pairs} and workers {workers}; give at least one episode and process, and no "
                           "fewer than 0 pairs")
    room_for(plot)
    played, robot, task, who = _policy(policy, target)
    import json as js

    from toolkit.evaluation.stress import CONDITIONS, Ledger, pair_trials, ranges_of, single_trials
    from toolkit.evaluation.stress import stress as play
    from toolkit.io.atomic import write_atomically

    names = tuple(conditions) or tuple(CONDITIONS)
    single = single_trials(names)
    ledger = Ledger(out / "episodes.jsonl" if out else None, {"format": "meta-evolve stress", "version": 1, **who})
    cores = workers or len(os.sched_getaffinity(0))
    try:
        with Progress("stress", quiet=json) as progress:
            alone = play(played, robot, task, single, episodes, ledger, cores, _rate(progress, f"{robot.name} alone"))
            ranges = ranges_of(alone)
            drawn = pair_trials(ranges, pairs)
            together = play(played, robot, task, drawn, episodes, ledger, cores, _rate(progress, f"{robot.name} pairs"))
    finally:
        ledger.close()
    content = {
        "policy": who["policy"], "target": robot.name, "task": task.name, "episodes": episodes,
        "ranges": {name: {"low": low, "high": high, "unit": CONDITIONS[name].unit, "nominal": CONDITIONS[name].nominal,
                          "meaning": CONDITIONS[name].meaning} for name, (low, high) in ranges.items()},
        "alone": [_row(tried) for tried in alone], "pairs": [_row(tried) for tried in together],
    }
    if out:
        write_atomically(out / "result.json", (js.dumps(content, indent=1) + "\n").encode())
    if plot:
        from toolkit.inspection.report.stress import stress_figure

        stress_figure(robot.name, alone, plot)
    if json:
        emit(content, True, "")
        return
    _tables(robot.name, alone, together, ranges)


def _policy(name: str, target: str | None) -> tuple["GaussianPolicy | Path", "Robot", "PickTask", dict[str, Any]]:
    """What plays on which robot in which task, and the same for the ledger."""
    if is_bundle(name):
        if target is not None:
            raise ToolkitError(f"{name} is a bundle, whose robot is written in it; leave --target {target} out")
        bundle, robot, task = bundle_roles(name)
        return bundle.path, robot, task, {"policy": bundle.manifest.sha256["policy.safetensors"], "target": robot.name, "task": task.name}
    import hashlib

    content, policies, _ = trained_policies(Path(name), target)
    if len(policies) != 1:
        raise ToolkitError(f"{name} has policies for {', '.join(policies)}; choose one by --target")
    player, trained = next(iter(policies.items()))
    digest = hashlib.sha256((Path(name) / f"{player}.policy.safetensors").read_bytes()).hexdigest()
    return trained, find_arm(player), find_pick(content["task"]), {"policy": digest, "target": player, "task": content["task"]}


def _rate(progress: Progress, title: str) -> Any:
    """A callback (done, total, what) that shows episodes per second and the time left."""
    import time

    began, first = time.monotonic(), list[int]()

    def seen(done: int, total: int, what: str) -> None:
        first.append(done) if not first else None
        passed, played = time.monotonic() - began, done - first[0] + 1
        left = (total - done) * passed / played
        progress.show(title, f"{done} of {total} episodes, {played / passed:.1f}/s, {left / 60:.0f} min left; {what}", done, total,
                      now=done == total)

    return seen


def _row(tried: "Tried") -> dict[str, Any]:
    return {"conditions": dict(tried.conditions), "episodes": tried.episodes, "successes": tried.successes, "success_rate": tried.rate}


def _tables(robot: str, alone: list["Tried"], together: list["Tried"], ranges: dict[str, tuple[float, float]]) -> None:
    from toolkit.evaluation.stress import CONDITIONS, told_of

    nominal = next(tried for tried in alone if not tried.conditions)
    rows = []
    for name, (low, high) in ranges.items():
        values = [f"{t.conditions[name]:g}: {t.successes}" for t in alone if name in t.conditions]
        unit = "" if CONDITIONS[name].unit == "1" else f" {CONDITIONS[name].unit}"
        rows.append([name, f"{low:g} to {high:g}{unit}", "  ".join(values)])
    table(f"{robot}: nominal {nominal.successes} of {nominal.episodes}; holds (success of at least 0.9) where",
          ["condition", "from, to", f"successes of {nominal.episodes} at"], rows)
    if together:
        table("Pairs within these ranges", ["conditions", "success"],
              [[told_of(t.conditions), f"{t.successes} of {t.episodes}"] for t in sorted(together, key=lambda t: t.rate)])
