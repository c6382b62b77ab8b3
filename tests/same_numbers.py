"""Prints a digest of what a match, a tree, F, some episodes, a short transfer and a bundle come to: the same before and after code moves.

    python tests/same_numbers.py > before.txt    # then move, and compare
"""

import hashlib
import json
import logging
import os
import sys
import tempfile
from pathlib import Path

import numpy as np
from safetensors.numpy import load_file

from robots import ROBOTS
from tasks import TASKS
from toolkit.bundle.manifest import Lineage, Success
from toolkit.evaluation.success import evaluate_merged
from toolkit.expert.shelf import load_expert
from toolkit.export.packing import write_bundle
from toolkit.learning.npg import NpgConfig
from toolkit.morphology.lab import Lab
from toolkit.morphology.native_scene import model_sha256
from toolkit.runs.run import Run
from toolkit.simulation.native import NativeRobot
from toolkit.simulation.rollout import NativeEngine, RolloutEngine
from toolkit.simulation.watching import States
from toolkit.transfer.pipeline import Job, Pipeline
from toolkit.transfer.settings import TransferConfig

TIMING = {"episodes_per_s", "play_s", "learn_s", "seconds"}
PLACES = {"git.json", "versions.json", "recording.rrd", "metrics.jsonl", "report.json", "summary.md", "transfer.safetensors"}
"""Files of a run that say when or where it ran."""


def digest(*parts):
    """sha256 of arrays, bytes and JSON values."""
    found = hashlib.sha256()
    for part in parts:
        if isinstance(part, np.ndarray):
            found.update(str(part.dtype).encode() + str(part.shape).encode() + np.ascontiguousarray(part).tobytes())
        else:
            found.update(part if isinstance(part, bytes) else json.dumps(part, sort_keys=True, default=str).encode())
    return found.hexdigest()[:16]


def say(what, *parts):
    print(f"{digest(*parts)}  {what}", flush=True)


def episode_parts(episodes):
    for episode in episodes:
        yield from (value for value in vars(episode).values())


def numbers(report):
    return {key: value for key, value in report.items() if key not in ("wall_s", "time")}


def main():
    logging.getLogger("robosuite_logs").setLevel(logging.ERROR)
    task = TASKS["061_foam_brick"]
    lab = Lab(ROBOTS["adroit"], [ROBOTS["jaco"], ROBOTS["kinova3"]], task)
    space = lab.space
    say("match", space.matching.names, [parameter.name for parameter in space.parameters], *space.betas)
    for metric in ("l1", "l2"):
        for kind in ("steiner", "geometric-median", "independent"):
            say(f"tree {metric} {kind}", lab.tree(metric, kind).to_json())
    rng = np.random.default_rng(0)
    for k in range(3):
        model, data = lab.merged.new()
        lab.merged.become(rng.uniform(size=space.size), model, data)
        say(f"F {k}", *(np.array(getattr(model, name)) for name in ("body_pos", "body_quat", "body_mass", "body_inertia", "jnt_pos",
            "jnt_axis", "jnt_range", "geom_pos", "geom_size", "dof_armature", "dof_damping", "actuator_gainprm", "qpos0")))
    policy, _ = load_expert("adroit", task)
    engine = RolloutEngine(lab.merged, threads=2)
    say("episodes on F", *episode_parts(engine.play(policy.act, [space.betas[0]] * 3, [1, 2, 3])))
    say("evaluation on F", evaluate_merged(policy, engine, "jaco", 2).to_json())
    engine.close()
    compiled = NativeEngine(ROBOTS["jaco"], task)
    say("episodes, compiled", *episode_parts(compiled.play(policy.act, [np.zeros(1)] * 2, [1, 2])))
    compiled.close()
    native, states = NativeRobot(ROBOTS["jaco"], task), States()
    say("episode, robosuite", native.play(policy.mean, 5, states), *states.qpos)
    say("model", model_sha256(native.model))
    with tempfile.TemporaryDirectory() as name:
        os.chdir(name)
        config = TransferConfig(xi=0.5, check_episodes=4, goal_episodes=4, path_budget=24, check_every=2, learner="npg", npg=NpgConfig())
        job = Job(ROBOTS["adroit"], (ROBOTS["kinova3"],), task, config, evaluation_episodes=2)
        report = Pipeline(job, Path("run")).play()
        say("report", numbers(report))
        records = [{k: v for k, v in record.items() if k not in TIMING} for record in Run.open(Path("run")).read_metrics()]
        say("metrics", records)
        for file in sorted(Path("run").rglob("*")):
            if file.is_file() and file.name not in PLACES and not file.name.startswith("."):
                say(str(file), file.read_bytes())
        lineage = Lineage("adroit", ("adroit", "kinova3"), (0.0, 1.0), "steiner", "l1", 3, 120)
        label = Success(40, 30, 0.75, (0.59, 0.86), 10**9, "nowhere: a test")
        manifest = write_bundle(policy, ROBOTS["kinova3"], task, {}, lineage, label, Path("bundle"), episodes=(1, 1)).to_json()
        said = {key: value for key, value in manifest.items() if key not in ("versions", "git", "sha256", "created")}
        say("manifest", said)
        for file in ("golden.npz", "robot.xml", "policy.safetensors"):
            say(f"bundle/{file}", (Path("bundle") / file).read_bytes())
        actor = load_file("bundle/actor.safetensors")  # its header's entries come in any order
        say("bundle/actor.safetensors", *(part for name in sorted(actor) for part in (name, actor[name])))
        os.chdir("/")


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))
    main()
