"""Episodes played on many machines, by Ray's actors: the same batches with the same numbers as of the engines of this machine.

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
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any
from uuid import uuid4

import numpy as np

from tasks.task import Task
from toolkit.errors import ToolkitError
from toolkit.learning.episode import Episode
from toolkit.learning.policy import GaussianPolicy
from toolkit.morphology.lab import Lab, Merged, System
from toolkit.quiet import silence_robosuite
from toolkit.runs.provenance import code_digest, recorded_versions
from toolkit.simulation.divergence import Divergence
from toolkit.simulation.laws import Playable, native_robot
from toolkit.simulation.rollout import Actor, Engine, NativeEngine, RolloutEngine, at_task

PATIENCE = 120.0
"""Time [s] for one episode, some hundred times what it takes, after which its actor counts as lost."""
START = 300.0
"""Time [s] without a single actor after which the cluster counts as too small; one takes some ten seconds to merge the robots."""
ATTEMPTS = 5
"""Actors that may be lost with one episode while their nodes live on: it may be what kills them."""
LOOK = 5.0
"""Time [s] between two looks at the cluster: for processors that have joined it, and whether its head is there."""
GONE = 30.0
"""Time [s] without an answer after which the head counts as gone."""
GIVE_UP = 600
"""Time [s] after which Ray itself ends this process because the head has gone: long after we have seen to that ourselves."""
SLICE = 0.5
"""Longest time [s] for which a thread waits in Ray before it looks whether it is still wanted."""


@dataclass(frozen=True)
class Scene:
    """Who plays what: all that an actor needs to know of a job.

    Attributes:
        robots: a source and its targets, which are merged; or the one unmodified robot.
        task: what they do.
        native: whether it is the unmodified robot.
        key: by which actors know it again: a card that has travelled need not equal itself.
    """

    robots: tuple[System, ...]
    task: Task
    native: bool = False
    key: str = field(default_factory=lambda: uuid4().hex, compare=False)

    def engine(self) -> RolloutEngine | NativeEngine:
        """Plays it here, on one thread."""
        if self.native:
            return NativeEngine(self.robots[0], self.task, threads=1)
        return RolloutEngine(Lab(self.robots[0], self.robots[1:], self.task).merged, threads=1)


def numbers(engine: RolloutEngine | NativeEngine) -> str:
    """Digest of an episode that a fixed policy plays on an engine's first robot: equal where simulation and policy have the same bits."""
    alpha = np.zeros(1) if isinstance(engine, NativeEngine) else engine.merged.space.beta(engine.merged.space.names[0])
    policy = GaussianPolicy(engine.task.observation.names, engine.task.action.names, np.random.default_rng(0))
    (episode,) = engine.play(policy.act, [alpha], [0])
    return hashlib.sha256(episode.observations.tobytes() + episode.actions.tobytes()).hexdigest()[:12]


def identity() -> dict[str, Any]:
    """What has to be the same on all machines for the same numbers to come out; the numbers are compared as well."""
    return {**recorded_versions(), "code": code_digest()[:12]}


class Player:
    """What an actor holds: the robots of every scene that it has played, each made when it is first played."""

    def __init__(self) -> None:
        silence_robosuite()
        self._engines: dict[str, RolloutEngine | NativeEngine] = {}
        self._environments: dict[str, Playable] = {}

    def identity(self) -> tuple[str, str, dict[str, Any]]:
        """Ray's name of the node, the machine's own, and its identity."""
        return imported_ray().get_runtime_context().get_node_id(), socket.gethostname(), identity()

    def numbers(self, scene: Scene) -> str:
        """As of ``numbers``, of a scene."""
        return numbers(self._engine(scene))

    def play(self, scene: Scene, actor: Actor, alpha: np.ndarray, seed: int) -> tuple[Episode, Divergence | None]:
        """One episode."""
        return self._engine(scene).one(actor, alpha, seed)

    def judge(self, scene: Scene, act: Callable[[np.ndarray], np.ndarray], seed: int) -> tuple[bool, bool]:
        """Whether an episode on the unmodified robot, by its environment's own step, succeeded, and whether it diverged."""
        if scene.key not in self._environments:
            self._environments[scene.key] = native_robot(scene.robots[0], scene.task)
        robot = self._environments[scene.key]
        return robot.play(act, seed), robot.diverged

    def _engine(self, scene: Scene) -> RolloutEngine | NativeEngine:
        if scene.key not in self._engines:
            self._engines[scene.key] = scene.engine()
        return self._engines[scene.key]


class Lookout:
    """An actor that asks the head what there is, so that no job has to: Ray ends a process that asks a head in another's place."""

    def processors(self) -> dict[str, float]:
        """Ray's name of every node that lives -> its processors."""
        return {node["NodeID"]: node["Resources"].get("CPU", 0.0) for node in imported_ray().nodes() if node["Alive"]}


@dataclass(eq=False)
class _RemoteActor:
    """An actor of one connection to the cluster, the node and machine where it is, and the scenes that it plays to the right bits."""

    actor: Any
    connection: int
    node: str = ""
    machine: str = ""
    proven: set[str] = field(default_factory=set)


class _Severed(Exception):
    """The head has gone: what was asked of its actors will not be answered."""


class Cluster:
    """The actors of a job on a Ray cluster, one per processor; several engines, of several jobs too, share them.

    A head that goes and comes back at its address is connected to again, and everything that was under way is played again.

    Args:
        address: "auto" for the cluster that this machine belongs to, or HOST:PORT of its head.
        actors: how many at most; default: the cluster's processors, those that join it later included.
        patience, start, gone: times [s] as of PATIENCE, START and GONE.

    Attributes:
        ready: actors that play or could.
        lost: actors that died, or did not answer in time.

    Raises:
        ToolkitError: Ray is not installed, or no cluster is there.
    """

    def __init__(
        self, address: str, actors: int | None = None, patience: float = PATIENCE, start: float = START, gone: float = GONE
    ) -> None:
        self.address, self.patience, self._start, self._gone, self._most = address, patience, start, gone, actors
        self._own = identity()
        self._ray, self._ours = _connected(address)
        self._head = self._ray.get_runtime_context().gcs_address
        self._idle: SimpleQueue = SimpleQueue()
        self._held: list[_RemoteActor] = []
        self._scenes: list[Scene] = []  # those that were admitted, each once
        self._numbers: dict[str, str] = {}  # a scene's key -> digest of what this machine plays
        self._changing, self._admitting = threading.Lock(), threading.Lock()
        self._closed, self._severed = threading.Event(), threading.Event()
        self._refusal = ""
        self.asked = self.ready = self.lost = self._connection = 0
        self._threads: list[threading.Thread] = []
        self._begin_with_head()
        self._start_thread(self._watch)

    # ---- what others ask of it ---------------------------------------------------------------------------------

    def merged(self, lab: Lab, dump: Path | None = None) -> "ClusterEngine":
        """Plays on a job's merged robot; see ClusterEngine."""
        return ClusterEngine(self, Scene((lab.source, *lab.targets), lab.task), lab.merged, dump)

    def native(self, robot: System, task: Task, dump: Path | None = None) -> "ClusterEngine":
        """Plays on an unmodified robot with the compiled control step; see ClusterEngine."""
        return ClusterEngine(self, Scene((robot,), task, native=True), None, dump)

    def judged(
        self, robot: System, task: Task, act: Callable[[np.ndarray], np.ndarray], seeds: Sequence[int]
    ) -> Iterator[tuple[bool, bool]]:
        """As of Player.judge, of every seed in order."""
        scene = self.admit(Scene((robot,), task, native=True))
        pool = ThreadPoolExecutor(max(64, 4 * self.asked))
        try:
            yield from pool.map(lambda seed: self.call("judge", scene, act, seed), seeds)
        finally:
            pool.shutdown(cancel_futures=True)

    def admit(self, scene: Scene, merged: Merged | None = None) -> Scene:
        """Play a scene from now on: an actor does so once it has played an episode of it to the bits of this machine.

        Args:
            scene: who plays what.
            merged: its merged robot, if there is one already.

        Returns:
            the scene, as actors know it.

        Raises:
            ToolkitError: the cluster has no room for an actor, or its nodes differ from this machine.
        """
        with self._admitting:
            known = next((other for other in self._scenes if other == scene), scene)
            if known is scene:
                engine = scene.engine() if merged is None else RolloutEngine(merged, threads=1)
                self._numbers[scene.key] = numbers(engine)
                self._scenes.append(scene)
                engine.close()
            self.grow()
        self.give_back(self.borrow())  # the others join while the first ones play
        return known

    def grow(self) -> None:
        """Ask for an actor on every processor that the cluster has by now."""
        with self._changing:
            wanted = max(1, self._there if self._most is None else min(self._there, self._most))
            more, self.asked = wanted - self.asked, max(self.asked, wanted)
        for _ in range(more):
            self._start_thread(self._bring_up)

    def call(self, method: str, scene: Scene, *arguments: Any, stopped: threading.Event | None = None) -> Any:
        """What a method of Player answers of a scene to these arguments, the last of them an episode's seed; whichever actor answers.

        Args:
            method, scene, arguments: what is asked.
            stopped: the answer is not waited for once it is set.

        Raises:
            ToolkitError: as of ``borrow``, or the method's own; or actors are lost again and again with that episode.
        """
        errors, lost = self._ray.exceptions, 0
        while lost < ATTEMPTS:
            remote = self.borrow(stopped)
            try:
                self._prove(remote, scene, stopped)
                ask = getattr(remote.actor, method)
                answer = self._answer(lambda: ask.remote(scene, *arguments), self.patience, stopped)  # noqa: B023 - asked at once
            except _Severed:
                continue
            except errors.RayTaskError as error:
                self.give_back(remote)
                raise error.cause if isinstance(error.cause, ToolkitError) else error from None
            except (errors.RayError, ConnectionError):
                lost += self._lives(remote.node)  # a node's end is no episode's fault
                self.lose(remote)
            except ToolkitError:  # it goes on with what nobody waits for any more
                self.give_back(remote)
                raise
            else:
                self.give_back(remote)
                return answer
        raise ToolkitError(
            f"{ATTEMPTS} actors of the Ray cluster at {self.address} were lost in turn with the episode of seed {arguments[-1]}; look at "
            "the memory of its nodes, and continue with --resume"
        )

    def borrow(self, stopped: threading.Event | None = None) -> _RemoteActor:
        """An actor that has nothing to do.

        Raises:
            ToolkitError: there has been none for long, or one was refused, or nobody waits any more.
        """
        while True:
            self._refuse(stopped)
            try:
                remote = self._idle.get(timeout=SLICE)
            except Empty:
                if self.ready or self._severed.is_set():
                    self._alive = time.monotonic()
                elif time.monotonic() - self._alive > self._start:
                    raise ToolkitError(
                        f"the Ray cluster at {self.address} has had no processor free for an episode for {self._start:.0f} s; look at "
                        "`ray status`, add a node, and continue with --resume"
                    ) from None
            else:
                if remote.connection == self._connection:
                    return remote

    def wait(self) -> None:
        """Until every actor that was asked for is ready.

        Raises:
            ToolkitError: one was refused, or has found no room in time.
        """
        limit = time.monotonic() + self._start
        while self.ready < self.asked:
            self._refuse()
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
            if remote.connection != self._connection:
                return
            self.ready -= 1
            self.lost += 1
            self._alive = time.monotonic()
        if not self._closed.is_set():
            self._drop(remote)
            self._start_thread(self._bring_up)

    def close(self) -> None:
        """End the actors, and the connection if it was made here."""
        self._closed.set()
        for thread in self._threads:
            thread.join(self._gone)  # one that waits for a head that has just gone waits for ever
        with self._changing:
            held, self._held = self._held, []
        if not self._severed.is_set():
            killing = threading.Thread(target=lambda: [self._ray.kill(remote.actor) for remote in held], daemon=True)
            killing.start()
            killing.join(self._gone)
        if self._ours:
            self._ray.shutdown()

    # ---- actors ------------------------------------------------------------------------------------------------

    def _start_thread(self, work: Callable[[], None]) -> None:
        def until_closed() -> None:
            try:
                work()
            except Exception:
                if not self._closed.is_set():  # else Ray was shut down under a question whose answer nobody waits for
                    raise

        thread = threading.Thread(target=until_closed, daemon=True)
        self._threads = [*(other for other in self._threads if other.is_alive()), thread]
        thread.start()

    def _bring_up(self) -> None:
        """Wait until an actor has room and is ready, however often it dies before that; refuse one that differs."""
        connection = self._connection
        while not self._closed.is_set() and not self._severed.is_set() and connection == self._connection:
            remote = _RemoteActor(self._actor.remote(), connection)
            with self._changing:
                self._held.append(remote)
            try:
                self._examine(remote)
            except _Severed:
                return
            except ToolkitError as error:
                self._refusal = self._refusal or str(error)
                return
            except (self._ray.exceptions.RayError, ConnectionError) as error:
                if isinstance(error, self._ray.exceptions.RayTaskError) or "creation task" in str(error):
                    self._refusal = f"an actor on the Ray cluster at {self.address} cannot begin ({_sentence(error)}); mend that node"
                    return
                self._drop(remote)
                self._closed.wait(1.0)
                continue
            with self._changing:
                if connection != self._connection:
                    return
                self.ready += 1
            self._idle.put(remote)
            return

    def _examine(self, remote: _RemoteActor) -> None:
        """Compare an actor's versions and code with this machine's, and an episode of the first scene."""
        remote.node, remote.machine, theirs = self._answer(remote.actor.identity.remote, float("inf"))
        for key, value in self._own.items():
            if theirs.get(key) != value:
                what = "code of the toolkit" if key == "code" else key
                raise ToolkitError(
                    f"node {remote.machine} has {what} {theirs.get(key)}, this machine {value}; install the same on all nodes"
                )
        self._prove(remote, self._scenes[0])

    def _prove(self, remote: _RemoteActor, scene: Scene, stopped: threading.Event | None = None) -> None:
        """Compare the bits of an episode of a scene with this machine's, before the first of those that count."""
        if scene.key in remote.proven:
            return
        if self._answer(lambda: remote.actor.numbers.remote(scene), self._start, stopped) != self._numbers[scene.key]:
            self._refusal = (
                f"node {remote.machine} has this machine's versions but plays an episode to other bits, as another kind of processor may; "
                "leave it out of the cluster, or start from a machine of its kind"
            )
            raise ToolkitError(self._refusal)
        remote.proven.add(scene.key)

    def _answer(self, ask: Callable[[], Any], seconds: float, stopped: threading.Event | None = None) -> Any:
        """What an actor answers, once ``ask`` has asked it; nothing is asked of Ray that nobody wants to know any more.

        Raises:
            GetTimeoutError: not within that time, or another error of Ray's.
            ToolkitError: nobody waits for it any more.
        """
        limit, reference = time.monotonic() + seconds, None
        while True:
            self._refuse(stopped)
            if self._severed.is_set():
                raise _Severed
            reference = ask() if reference is None else reference
            try:
                return self._ray.get(reference, timeout=SLICE)
            except self._ray.exceptions.GetTimeoutError:
                if time.monotonic() > limit:
                    raise

    def _refuse(self, stopped: threading.Event | None = None) -> None:
        """Raise what ends the work, if anything does."""
        if self._refusal:
            raise ToolkitError(self._refusal)
        if self._closed.is_set() or (stopped is not None and stopped.is_set()):
            raise ToolkitError(f"the connection to the Ray cluster at {self.address} is closed; begin another")

    def _drop(self, remote: _RemoteActor) -> None:
        with self._changing:
            self._held = [other for other in self._held if other is not remote]
        self._start_thread(lambda: self._ray.kill(remote.actor))  # waits for a head, even for one that has gone

    def _lives(self, node: str) -> bool:
        try:
            return node in self._processors()
        except ToolkitError:
            return False  # the head has gone, and all else with it

    # ---- the head ----------------------------------------------------------------------------------------------

    def _begin_with_head(self) -> None:
        self._there = int(sum(node["Resources"].get("CPU", 0) for node in self._ray.nodes() if node["Alive"]))
        self._heard, self._alive = False, time.monotonic()
        self._actor = self._ray.remote(num_cpus=1, max_restarts=0, max_task_retries=0)(Player)
        self._lookout = self._ray.remote(num_cpus=0, max_restarts=-1)(Lookout).remote()

    def _processors(self) -> dict[str, float]:
        """As of Lookout.processors.

        Raises:
            ToolkitError: the head does not answer.
        """
        limit = time.monotonic() + (self._gone if self._heard else self._start)  # a process takes its time to begin
        while time.monotonic() < limit:
            try:
                found = self._answer(self._lookout.processors.remote, limit - time.monotonic())
                self._heard = True
                return found
            except (self._ray.exceptions.RayError, ConnectionError):
                self._closed.wait(SLICE)  # it begins again on another node, if there is a head
            except _Severed:
                break
        raise ToolkitError(
            f"the head of the Ray cluster at {self.address} has not answered for {self._gone:.0f} s; begin the cluster again, and continue "
            "with --resume"
        )

    def _watch(self) -> None:
        """Look for processors that have joined, and whether the head is there; connect to one that has come back."""
        while not self._closed.wait(LOOK):
            try:
                self._there = int(sum(self._processors().values()))
            except ToolkitError:
                if self._refusal or self._closed.is_set():
                    return
                self._connect_again()
            if self._scenes:
                self.grow()

    def _connect_again(self) -> None:
        """Wait for a head at the same address, and begin anew with it."""
        self._severed.set()
        with self._changing:
            self._connection += 1
            self._held, self._idle, self.asked, self.ready = [], SimpleQueue(), 0, 0
        gone = (f"the head of the Ray cluster at {self.address} has gone and not come back within {self._start:.0f} s; begin the cluster "
                "again, and continue with --resume")
        if not self._ours:
            self._refusal = gone  # whose connection it is decides what becomes of it
            return
        self._closed.wait(3 * SLICE)  # until nobody is inside Ray
        self._ray.shutdown()
        limit = time.monotonic() + self._start
        while not self._closed.is_set():
            if time.monotonic() > limit:
                self._refusal = gone
                return
            if _answers(self._head):
                try:
                    _connected(self._head)
                except ToolkitError:
                    self._closed.wait(1.0)
                    continue
                self._begin_with_head()
                with self._changing:
                    self.asked = 0
                self._severed.clear()
                return
            self._closed.wait(1.0)


@contextmanager
def cluster_at(address: str | None) -> Iterator[Cluster | None]:
    """The cluster at an address, for the time of a command; None without one: this machine plays.

    Raises:
        ToolkitError: as of Cluster.
    """
    if address is None:
        yield None
        return
    cluster = Cluster(address)
    try:
        yield cluster
    finally:
        cluster.close()


class ClusterEngine(Engine):
    """Plays batches of episodes on a cluster; made by ``Cluster.merged`` and ``Cluster.native``, see RolloutEngine and NativeEngine.

    Args:
        cluster: who plays.
        scene: on whom.
        merged: its merged robot; None: the unmodified one plays.
        dump: file for the first simulation that blows up; one that exists is left alone.

    Raises:
        ToolkitError: as of Cluster.admit.
    """

    def __init__(self, cluster: Cluster, scene: Scene, merged: Merged | None, dump: Path | None = None) -> None:
        known = cluster.admit(scene, merged)
        super().__init__(max(64, 4 * cluster.asked), dump)  # threads that wait for answers; a cluster may grow
        self.cluster, self.scene, self.task, self._merged = cluster, known, scene.task, merged

    @property
    def merged(self) -> Merged:
        """The merged robot that plays.

        Raises:
            ToolkitError: it is an unmodified one.
        """
        if self._merged is None:
            raise ToolkitError(f"robot {self.scene.robots[0].name!r} plays as it is here; give an engine of a merged robot")
        return self._merged

    def at(self, task: Task) -> "ClusterEngine":
        """See Engine."""
        merged = None if self._merged is None else at_task(self._merged, task)
        return ClusterEngine(self.cluster, Scene(self.scene.robots, task, self.scene.native), merged)

    def one(self, actor: Actor, alpha: np.ndarray, seed: int) -> tuple[Episode, Divergence | None]:
        """See Engine.

        Raises:
            ToolkitError: the cluster has become too small, or a node that differs has joined it.
        """
        episode, divergence = self.cluster.call("play", self.scene, actor, alpha, seed, stopped=self.stopped)
        return replace(episode), divergence  # its arrays are read-only again

    def _scene(self) -> dict[str, Any]:
        return {"robots": tuple(robot.name for robot in self.scene.robots), "native": self.scene.native, "task": self.task.name}


def _answers(address: str) -> bool:
    """Whether somebody listens at HOST:PORT."""
    host, _, port = address.rpartition(":")
    try:
        socket.create_connection((host, int(port)), timeout=5.0).close()
    except OSError:
        return False
    return True


def imported_ray() -> Any:
    """Ray, which reports nothing to its makers, begins no cluster of its own, and leaves it to us when to give a head up.

    Raises:
        ToolkitError: it is not installed.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_ENABLE_AUTO_CONNECT", "0")
    os.environ.setdefault("RAY_gcs_rpc_server_reconnect_timeout_s", str(GIVE_UP))
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
    try:
        if address != "auto" and not _answers(address):  # Ray itself would try for minutes
            raise ConnectionError("connection refused")
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
