"""Episodes on a Ray cluster against this machine's own engine: how fast, with which bits, at what cost in bytes and time to start."""

import os
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from toolkit.benchmarks.paper import PAPER, SEEDS
from toolkit.benchmarks.results import finished_runs
from toolkit.learning.episode import Episode
from toolkit.learning.policy import GaussianPolicy
from toolkit.morphology.lab import Lab
from toolkit.simulation.cluster import Cluster, imported_ray
from toolkit.simulation.rollout import Engine, RolloutEngine

CORES = (16, 256, 4096)
"""Processors for which a rate is worked out from what was measured."""
STORE = 100 * 2**20
"""Bytes of a node's object store; an episode passes through it only where it is larger than what Ray sends with an answer."""


def local_nodes(stack: ExitStack, processors: Sequence[int]) -> str:
    """Address of a cluster of nodes on this machine, one per number of processors, which ends with the ``stack``."""
    imported_ray()
    from ray.cluster_utils import Cluster as Nodes

    head = {"num_cpus": processors[0], "include_dashboard": False, "object_store_memory": STORE}
    nodes = Nodes(initialize_head=True, head_node_args=head)
    stack.callback(nodes.shutdown)
    for count in processors[1:]:
        nodes.add_node(num_cpus=count, object_store_memory=STORE)
    return nodes.address


def same_bits(found: Sequence[Episode], wanted: Sequence[Episode]) -> bool:
    """Whether all arrays, counts and endings of the episodes are equal bit for bit."""
    pairs = zip(found, wanted, strict=True)
    return all(np.array_equal(value, getattr(other, name)) for one, other in pairs for name, value in vars(one).items())


def paper_tables(episode_s: float) -> list[dict[str, Any]]:
    """What the paper's tables would take, all seeds side by side, if an episode took a core so long [s].

    A seed has an equal share of the processors. Its policy updates come one after the other, and each waits for one episode at least; its
    episodes are played no faster than its processors allow. The longer of the two times counts; learning, checks and the tree's depth come
    on top.

    Returns:
        a row per method and task: ``hours`` for each of ``CORES``, and the fewest ``cores`` with which updates are the limit.
    """
    rows = []
    for suite, methods in PAPER.items():
        for row in methods:
            iterations, episodes = row.train_iterations[0], row.sim_epochs[0]
            hours = [episode_s * max(iterations, episodes / (cores / SEEDS)) / 3600 for cores in CORES]
            rows.append({"suite": suite, "method": row.method, "task": row.task, "hours": hours,
                         "cores": int(np.ceil(SEEDS * episodes / iterations))})
    return rows


def run_times(folder: Path, episode_s: float) -> list[dict[str, Any]]:
    """What finished runs would take with five seeds side by side, if an episode took a core so long [s].

    As of ``paper_tables``, but for what is known of a run of ours: its batches (updates, checks, looks) come one after the other along the
    longest way from the source to a target, a tree that asks plays all of them in turn, and what it did beside playing it does again.

    Args:
        folder: of a suite's runs.
        episode_s: time of an episode [s].

    Returns:
        a row per method, targets and task that was played with three seeds at least, by its slowest seed: ``hours`` for each of ``CORES``.
    """
    groups: dict[tuple[str, ...], list[list[float]]] = {}
    for result in finished_runs(folder):
        report = result.report
        if "time" not in report:
            continue
        batches = Counter(record["path"] for record in result.metrics if record["event"] in ("update", "check", "look"))
        ways = [sum(count for other, count in batches.items() if path == other or path.startswith(f"{other}.")) for path in batches]
        chain = batches.total() if report["kind"] == "asking" else max(ways, default=0)
        evaluated = [one["episodes"] for both in report["targets"].values() for one in both.values()]
        evaluated += [one["episodes"] for one in report.get("untrained", {}).values()]
        episodes = report["totals"]["sim_epochs"] + report["totals"]["check_episodes"] + sum(evaluated)
        beside = report["time"]["wall_s"] * report["time"]["outside_playing"]
        hours = [(episode_s * max(chain, episodes / (cores / SEEDS)) + beside) / 3600 for cores in CORES]
        groups.setdefault((result.method, ", ".join(sorted(report["targets"])), result.task), []).append(hours)
    return [{"method": method, "targets": targets, "task": task, "seeds": len(found),
             "hours": [max(hours) for hours in zip(*found, strict=True)]}
            for (method, targets, task), found in groups.items() if len(found) >= 3]


def measure_cluster(
    lab: Lab, address: str, policy: GaussianPolicy, actors: Sequence[int], episodes: int, rounds: int, paths: int, batch: int,
    runs: Path,
    progress: Callable[[str, str], None] = lambda title, detail: None,
) -> dict[str, Any]:
    """What ``meta-evolve bench cluster --json`` prints.

    Args:
        lab: whose merged robot plays, on robots between its source and its targets.
        address: of the cluster.
        policy: that plays, under its noise.
        actors: numbers of them that are tried, each against as many threads of this machine.
        episodes: of a batch.
        rounds: of each racer, in turns; the fastest counts.
        paths, batch: of a transfer for which ``projected`` is worked out: paths side by side, and episodes of an update.
        runs: folder of finished runs, for ``run_times``.
        progress: called with what is being measured.
    """
    space, rng = lab.space, np.random.default_rng(0)
    source, targets = space.beta(space.names[0]), [space.beta(name) for name in space.names[1:]]
    alphas = [source + rng.uniform() * (targets[i % len(targets)] - source) for i in range(episodes)]
    seeds, rows = list(range(episodes)), []
    for count in actors:
        progress("cluster", f"{count} actors")
        began = time.perf_counter()
        cluster = Cluster(address, count)
        there = cluster.merged(lab)
        cluster.wait()
        start_s = time.perf_counter() - began
        here = RolloutEngine(lab.merged, cluster.asked)
        try:
            times: dict[Engine, float] = {there: np.inf, here: np.inf}
            same = True
            for engine in times:
                engine.play(policy.act, alphas[:count], seeds[:count])  # the first episode compiles
            for _ in range(rounds):
                played = []
                for engine in times:
                    began = time.perf_counter()
                    played.append(engine.play(policy.act, alphas, seeds))
                    times[engine] = min(times[engine], time.perf_counter() - began)
                same = same and same_bits(*played)
            rows.append({"actors": cluster.asked, "start_s": start_s, "episodes_per_s": episodes / times[there], "same_bits": same,
                         "local_episodes_per_s": episodes / times[here], "ratio_to_local": times[here] / times[there],
                         "lost": cluster.lost})
        finally:
            there.close()
            here.close()
            cluster.close()
    sent = policy.parameters.nbytes + sum(array.nbytes for array in policy.layers()[1:3])
    returned = float(np.mean([sum(np.asarray(value).nbytes for value in vars(episode).values()) for episode in played[0]]))
    seconds = min(row["actors"] / row["episodes_per_s"] for row in rows)
    busy = {cores: min(cores, paths * batch) for cores in CORES}
    projected = [{"cores": cores, "busy": count, "episodes_per_s": count / seconds} for cores, count in busy.items()]
    return {"rows": rows, "bytes_sent": sent, "bytes_returned": returned, "episode_s": seconds, "paths": paths, "batch": batch,
            "projected": projected, "paper": paper_tables(seconds), "runs": run_times(runs, seconds),
            "cores": len(os.sched_getaffinity(0)), "load": os.getloadavg()[0]}
