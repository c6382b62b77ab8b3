"""Episodes played on many machines, by Ray's actors: the same batches with the same numbers as of the engine of this machine.

An episode is a function of policy, alpha, seed, robots and task, so that it does not matter who plays it, nor how often: one whose
actor dies, or does not answer in time, is played again by another, and its first answer counts. Actors whose code, versions or numbers
differ from this machine's are refused by name. Ray hands objects over by pickle: use it only between machines that trust one another.
"""

import hashlib
import logging
import os
import socket
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

import numpy as np

from tasks.task import Task
from toolkit.errors import ToolkitError
from toolkit.learning.episode import Episode
from toolkit.learning.policy import GaussianPolicy
from toolkit.morphology.lab import Lab, System
from toolkit.quiet import silence_robosuite
from toolkit.runs.provenance import code_digest, recorded_versions
from toolkit.simulation.divergence import Divergence
from toolkit.simulation.laws import Playable, native_robot
from toolkit.simulation.rollout import Actor, Engine, NativeEngine, RolloutEngine

PATIENCE = 120.0
"""Time [s] for one episode, some hundred times what it takes, after which its actor counts as lost."""
START = 300.0
"""Time [s] without a single actor after which the cluster counts as too small; one takes some ten seconds to merge the robots."""
ATTEMPTS = 5
"""Actors that may be lost with one episode while their nodes live on: it may be what kills them."""
GROWTH = 5.0
"""Time [s] between two looks for processors that have joined the cluster."""


def numbers(engine: RolloutEngine) -> str:
    """Digest of an episode that a fixed policy plays on the source's robot: equal where simulation and policy have the same bits."""
    space, task = engine.merged.space, engine.merged.task
    policy = GaussianPolicy(task.observation.names, task.action.names, np.random.default_rng(0))
    (episode,) = engine.play(policy.act, [space.beta(space.names[0])], [0])
    return hashlib.sha256(episode.observations.tobytes() + episode.actions.tobytes()).hexdigest()[:12]


def identity(engine: RolloutEngine) -> dict[str, Any]:
    """What has to be the same on all machines for the same numbers to come out, and at last the numbers."""
    return {**recorded_versions(), "code": code_digest()[:12], "numbers": numbers(engine)}


class Player:
    """What an actor holds: a job's robots, merged and unmodified, each made when it is first played.

    Args:
        source, targets, task: as of Lab.
    """

    def __init__(self, source: System, targets: Sequence[System], task: Task) -> None:
        silence_robosuite()
        self._engine = RolloutEngine(Lab(source, targets, task).merged, threads=1)
        self._robots, self._task = {robot.name: robot for robot in (source, *targets)}, task
        self._natives: dict[str, NativeEngine] = {}
        self._environments: dict[str, Playable] = {}

    def identity(self) -> tuple[str, str, dict[str, Any]]:
        """Ray's name of the node, the machine's own, and its identity."""
        return imported_ray().get_runtime_context().get_node_id(), socket.gethostname(), identity(self._engine)

    def play(self, native: str | None, actor: Actor, alpha: np.ndarray, seed: int) -> tuple[Episode, Divergence | None]:
        """One episode on F(alpha), or on the unmodified robot of that name."""
        if native is None:
            return self._engine.one(actor, alpha, seed)
        if native not in self._natives:
            self._natives[native] = NativeEngine(self._robots[native], self._task, threads=1)
        return self._natives[native].one(actor, alpha, seed)

    def judge(self, native: str, act: Callable[[np.ndarray], np.ndarray], seed: int) -> tuple[bool, bool]:
        """Whether an episode on the unmodified robot of that name, by its environment's own step, succeeded, and whether it diverged."""
        if native not in self._environments:
            self._environments[native] = native_robot(self._robots[native], self._task)
        robot = self._environments[native]
        return robot.play(act, seed), robot.diverged


@dataclass(eq=False)
class _RemoteActor:
    """An actor, and the node where it is."""

    actor: Any
    node: str = ""


class Cluster:
    """The actors of a job on a Ray cluster, one per processor; several engines may share them.

    Args:
        lab: the job's robots and task.
        address: "auto" for the cluster that this machine belongs to, or HOST:PORT of its head.
        actors: how many at most; default: the cluster's processors, those that join it later included.
        patience, start: times [s] as of PATIENCE and START.

    Attributes:
        ready: actors that play or could.
        lost: actors that died, or did not answer in time.

    Raises:
        ToolkitError: Ray is not installed, no cluster is there, its nodes differ from this machine, or none of them has room.
    """

    def __init__(
        self, lab: Lab, address: str, actors: int | None = None, patience: float = PATIENCE, start: float = START
    ) -> None:
        self.lab, self.address, self.patience, self._start, self._most = lab, address, patience, start, actors
        self._ray, self._ours = _connected(address)
        engine = RolloutEngine(lab.merged, threads=1)
        self._own = identity(engine)
        engine.close()
        self._actor = self._ray.remote(num_cpus=1, max_restarts=0, max_task_retries=0)(Player)
        self._idle: SimpleQueue = SimpleQueue()
        self._held: list[_RemoteActor] = []
        self._changing, self._closed = threading.Lock(), threading.Event()
        self._refusal = ""
        self.asked = self.ready = self.lost = 0
        self._alive = self._looked = time.monotonic()
        self.grow()
        try:
            self._idle.put(self.borrow())  # the others join while the first ones play
        except BaseException:
            self.close()
            raise

    def grow(self) -> None:
        """Ask for an actor on every processor that the cluster has by now."""
        with self._changing:
            now = time.monotonic()
            if self.asked and now - self._looked < GROWTH:
                return
            self._looked = now
            there = int(self._ray.cluster_resources().get("CPU", 0))
            wanted = max(1, there if self._most is None else min(there, self._most))
            more, self.asked = wanted - self.asked, max(self.asked, wanted)
        for _ in range(more):
            self._begin()

    def call(self, method: str, *arguments: Any) -> Any:
        """What a method of Player answers to these arguments, the last of them an episode's seed; whichever actor gives the answer.

        Raises:
            ToolkitError: as of ``borrow``, or the method's own; or actors are lost again and again with that episode.
        """
        errors, lost = self._ray.exceptions, 0
        while lost < ATTEMPTS:
            remote = self.borrow()
            try:
                answer = self._ray.get(getattr(remote.actor, method).remote(*arguments), timeout=self.patience)
            except errors.RayTaskError as error:
                self.give_back(remote)
                raise error.cause if isinstance(error.cause, ToolkitError) else error from None
            except (errors.RayError, ConnectionError):
                lost += self._lives(remote.node)  # a node's end is no episode's fault
                self.lose(remote)
            else:
                self.give_back(remote)
                return answer
        raise ToolkitError(
            f"{ATTEMPTS} actors of the Ray cluster at {self.address} were lost in turn with the episode of seed {arguments[-1]}; look at "
            "the memory of its nodes, and continue with --resume"
        )

    def judged(self, robot: System, act: Callable[[np.ndarray], np.ndarray], seeds: Sequence[int]) -> Iterator[tuple[bool, bool]]:
        """As of Player.judge, of every seed in order."""
        self.grow()
        pool = ThreadPoolExecutor(self.asked)
        try:
            yield from pool.map(lambda seed: self.call("judge", robot.name, act, seed), seeds)
        finally:
            pool.shutdown(cancel_futures=True)

    def borrow(self) -> _RemoteActor:
        """An actor that has nothing to do.

        Raises:
            ToolkitError: there has been none for long, or one was refused.
        """
        while True:
            if self._refusal or self._closed.is_set():
                raise ToolkitError(self._refusal or f"the connection to the Ray cluster at {self.address} is closed; begin another")
            try:
                return self._idle.get(timeout=0.5)
            except Empty:
                if self.ready:
                    self._alive = time.monotonic()
                elif time.monotonic() - self._alive > self._start:
                    raise ToolkitError(
                        f"the Ray cluster at {self.address} has had no processor free for an episode for {self._start:.0f} s; look at "
                        "`ray status`, add a node, and continue with --resume"
                    ) from None

    def wait(self) -> None:
        """Until every actor that was asked for is ready.

        Raises:
            ToolkitError: one was refused, or has found no room in time.
        """
        limit = time.monotonic() + self._start
        while self.ready < self.asked:
            if self._refusal:
                raise ToolkitError(self._refusal)
            if time.monotonic() > limit:
                raise ToolkitError(
                    f"only {self.ready} of {self.asked} actors found room on the Ray cluster at {self.address} within {self._start:.0f} s; "
                    "ask for fewer, or look at `ray status`"
                )
            time.sleep(0.05)

    def give_back(self, remote: _RemoteActor) -> None:
        """The actor has nothing to do any more."""
        self._idle.put(remote)

    def lose(self, remote: _RemoteActor) -> None:
        """The actor has died or is late: another one is asked for."""
        with self._changing:
            self.ready -= 1
            self.lost += 1
            self._alive = time.monotonic()
        if not self._closed.is_set():
            self._drop(remote)
            self._begin()

    def close(self) -> None:
        """End the actors, and the connection if it was made here."""
        self._closed.set()
        with self._changing:
            held, self._held = self._held, []
        for remote in held:
            self._ray.kill(remote.actor)
        if self._ours:
            self._ray.shutdown()

    def _lives(self, node: str) -> bool:
        try:
            return any(one["NodeID"] == node and one["Alive"] for one in self._ray.nodes())
        except (self._ray.exceptions.RayError, ConnectionError):
            return False  # the head has gone, and all else with it

    def _drop(self, remote: _RemoteActor) -> None:
        with self._changing:
            self._held = [other for other in self._held if other is not remote]
        self._ray.kill(remote.actor)

    def _begin(self) -> None:
        threading.Thread(target=self._bring_up, daemon=True).start()

    def _bring_up(self) -> None:
        """Wait until an actor has room and is ready, however often it dies before that; refuse one that differs."""
        while not self._closed.is_set():
            remote = _RemoteActor(self._actor.remote(self.lab.source, self.lab.targets, self.lab.task))
            with self._changing:
                self._held.append(remote)
            try:
                answer = remote.actor.identity.remote()
                while not self._ray.wait([answer], timeout=0.5)[0]:
                    if self._closed.is_set():
                        return
                remote.node, machine, theirs = self._ray.get(answer, timeout=self.patience)
            except (self._ray.exceptions.RayError, ConnectionError) as error:
                if isinstance(error, self._ray.exceptions.RayTaskError) or "creation task" in str(error):
                    self._refusal = f"an actor on the Ray cluster at {self.address} cannot begin ({_sentence(error)}); mend that node"
                    return
                self._drop(remote)
                self._closed.wait(1.0)
                continue
            differing = [key for key, value in self._own.items() if theirs.get(key) != value]
            if differing:
                self._refusal = self._difference(machine, theirs, differing[0])
                return
            with self._changing:
                self.ready += 1
            self._idle.put(remote)
            return

    def _difference(self, machine: str, theirs: dict[str, Any], key: str) -> str:
        if key == "numbers":
            return (f"node {machine} has this machine's versions but plays an episode to other bits, as another kind of processor may; "
                    "leave it out of the cluster, or start from a machine of its kind")
        what = "code of the toolkit" if key == "code" else key
        return f"node {machine} has {what} {theirs.get(key)}, this machine {self._own[key]}; install the same on all nodes"


class ClusterEngine(Engine):
    """Plays batches of episodes on a cluster, on the merged robot or on an unmodified one; see RolloutEngine and NativeEngine.

    Args:
        cluster: who plays.
        native: the unmodified robot; None: the merged one.
        dump: file for the first simulation that blows up; one that exists is left alone.
    """

    def __init__(self, cluster: Cluster, native: System | None = None, dump: Path | None = None) -> None:
        super().__init__(max(64, 4 * cluster.asked), dump)  # threads that wait for answers; a cluster may grow
        self.cluster, self.merged = cluster, cluster.lab.merged
        self._native = None if native is None else native.name

    def play(self, actor: Actor | Sequence[Actor], alphas: Sequence[np.ndarray], seeds: Sequence[int]) -> list[Episode]:
        """See Engine.

        Raises:
            ToolkitError: the cluster has become too small, or a node that differs has joined it.
        """
        self.cluster.grow()
        return super().play(actor, alphas, seeds)

    def one(self, actor: Actor, alpha: np.ndarray, seed: int) -> tuple[Episode, Divergence | None]:
        """See Engine."""
        episode, divergence = self.cluster.call("play", self._native, actor, alpha, seed)
        return replace(episode), divergence  # its arrays are read-only again

    def _scene(self) -> dict[str, Any]:
        names = self.merged.space.names if self._native is None else (self._native,)
        return {"robots": names, "native": self._native is not None, "task": self.merged.task.name}


def imported_ray() -> Any:
    """Ray, which reports nothing to its makers.

    Raises:
        ToolkitError: it is not installed.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        import ray
        import ray.exceptions
    except ImportError:
        raise ToolkitError("a cluster needs Ray, which is not installed; pip install 'meta-evolve[ray]' on all nodes") from None
    return ray


def _connected(address: str) -> tuple[Any, bool]:
    """Ray, connected, and whether the connection was made now."""
    ray = imported_ray()
    if ray.is_initialized():
        return ray, False
    host, _, port = address.rpartition(":")
    try:
        if address != "auto":
            socket.create_connection((host, int(port)), timeout=5.0).close()  # Ray itself would try for minutes
        ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
    except ValueError:
        raise ToolkitError(f"cluster {address!r} is no address; give auto, or HOST:PORT of the head as `ray start` printed it") from None
    except (OSError, RuntimeError) as error:
        raise ToolkitError(
            f"no Ray cluster answers at {address} ({_sentence(error)}); begin one with `ray start --head`, or check the address"
        ) from None
    return ray, True


def _sentence(error: Exception) -> str:
    """The last line of an error that says something, cut."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return (lines[-1] if lines else type(error).__name__)[:200]
