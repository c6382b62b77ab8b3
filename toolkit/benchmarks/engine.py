"""The engine measured against robosuite's own env.step and against bare mj_step: that it plays the same, and how fast.

    record      a real episode, from the first touch on: states, closing commands, and the controls of every step of physics
    race        engine, bare mj_step and robosuite over the same stretches, in turns, so that a busy machine slows all alike
    parity      the largest difference to env.step in free motion, in observations, and in how episodes end
    scale       episodes per second against batch, threads and the dimensions of the evolution space

Times of one thread are processor time, the least of several rounds per stretch; so another process that takes the core
between two of them does not count. Times of several threads are wall time and need an idle machine. A control step is one
action of the policy: 50 ms, 25 steps of physics.
"""

import ctypes
import dataclasses
import os
import platform
import re
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import date
from functools import partial
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numba import cfunc, types

from robots.robot import Robot
from tasks.pick import ACTION_SIZE, PickTask
from toolkit.morphology.build import MergedRobot
from toolkit.morphology.matching import match
from toolkit.morphology.native_scene import NativeScene
from toolkit.morphology.space import EvolutionSpace
from toolkit.simulation import osc
from toolkit.simulation.laws import merged_plant, native_plant
from toolkit.simulation.native import NativeRobot
from toolkit.simulation.osc import STATE
from toolkit.simulation.plant import Plant
from toolkit.simulation.rollout import Actor, RolloutEngine, play, play_on

STRETCH = 4
"""Control steps that are timed at once: long enough to time, short enough that all racers meet the same load."""
STRETCHES = 10
"""Stretches of an episode."""
ROUNDS = 8
"""Turns of every racer on every stretch."""
BATCHES = (1, 4, 16, 64, 256)
"""Environments of a batch."""
RECORDED_SEED = 3
"""Seed of the recorded episode."""

_mj_step: Any = types.ExternalFunction("mj_step", types.void(types.uintp, types.uintp))
_THREAD_CLOCK = int(time.CLOCK_THREAD_CPUTIME_ID)
_clock_gettime: Any = types.ExternalFunction("clock_gettime", types.int32(types.int32, types.uintp))


@osc.compiled
def bare_steps(model: int, data: int, controls: np.ndarray, ctrl: np.ndarray) -> None:
    """mj_step for every row of controls (n, nu); nothing else."""
    for row in controls:
        ctrl[:] = row
        _mj_step(model, data)


@cfunc(types.float64(), cache=True)
def _microseconds() -> float:
    now = np.empty(2, np.int64)
    _clock_gettime(_THREAD_CLOCK, now.ctypes.data)
    return 1e6 * now[0] + 1e-3 * now[1]


# ---- a real episode --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Stretches:
    """Contact-rich parts of an episode, STRETCH control steps each; n of them.

    Attributes:
        states: (n, n_state) mjSTATE_INTEGRATION before each.
        commands: (n, n_roles) closing commands before each.
        actions: (n, STRETCH, n_act) that the policy took.
        controls: (n, STRETCH * substeps, nu) of every step of physics.
        goal: (3,) [m].
        contacts, rows: means over the stretches of contacts and constraint rows.
    """

    states: np.ndarray
    commands: np.ndarray
    actions: np.ndarray
    controls: np.ndarray
    goal: np.ndarray
    contacts: float
    rows: float


def record(plant: Plant, actor: Actor, seed: int = RECORDED_SEED) -> Stretches:
    """Play one episode and keep stretches from the first touch of the object on, spread evenly."""
    model, data = plant.model, plant.data
    rng = np.random.default_rng((seed, 1))
    observation = plant.begin(seed)
    states, commands, actions, contacts, rows = [], [], [], [], []
    controls: list[list[np.ndarray]] = []
    touched = None
    for step in range(plant.task.horizon):
        if touched is None and _touches(plant):
            touched = step
        action = np.asarray(actor(observation, rng), float)
        states.append(np.empty(mujoco.mj_stateSize(model, STATE)))
        mujoco.mj_getState(model, data, states[-1], STATE)
        commands.append(plant.command.copy())
        actions.append(action)
        contacts.append(data.ncon)
        rows.append(data.nefc)
        plant.set_command(action)
        controls.append([])
        for substep in range(plant.substeps):
            plant.play_substeps(action, 1, sets_goal=substep == 0)
            controls[-1].append(np.array(data.ctrl))
        observation = plant.observe()
    last = plant.task.horizon - STRETCH
    starts = np.unique(np.linspace(min(touched or 0, last - STRETCHES), min(last, (touched or 0) + 60), STRETCHES).astype(int))
    pick = lambda values: np.array([values[s] for s in starts])  # noqa: E731
    runs = lambda values: np.array([values[s : s + STRETCH] for s in starts])  # noqa: E731
    return Stretches(
        pick(states), pick(commands), runs(actions), runs(controls).reshape(len(starts), -1, model.nu), plant.goal.copy(),
        float(np.mean(pick(contacts))), float(np.mean(pick(rows))),
    )


def _touches(plant: Plant) -> bool:
    """Whether the robot touches the object."""
    model, item = plant.model, plant.object_body
    pairs = [(int(model.geom_bodyid[c.geom1]), int(model.geom_bodyid[c.geom2])) for c in plant.data.contact]
    return any(item in pair and model.body_weldid[sum(pair) - item] != 0 for pair in pairs)


def _stand(plant: Plant, stretches: Stretches, index: int) -> None:
    mujoco.mj_setState(plant.model, plant.data, stretches.states[index], STATE)
    plant.command, plant.goal = stretches.commands[index].copy(), stretches.goal
    mujoco.mj_forward(plant.model, plant.data)
    mujoco.mj_setState(plant.model, plant.data, stretches.states[index], STATE)  # forward has changed the warm start


def _stand_natively(native: NativeRobot, stretches: Stretches, index: int) -> None:
    """Put robosuite's environment there too: its simulation, its gripper's integrated action, its count of steps."""
    model, data, env = native.model, native.data, native.env
    mujoco.mj_setState(model, data, stretches.states[index], STATE)
    ids = np.array(env.robots[0]._ref_joint_gripper_actuator_indexes["right"])
    low, high = model.actuator_ctrlrange[ids].T
    env.robots[0].gripper["right"].current_action = np.clip((2 * data.ctrl[ids] - low - high) / (high - low), -1, 1)
    native.command = stretches.commands[index].copy()
    env.timestep, env.done = 0, False


# ---- the race --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Race:
    """Control steps per second over the same stretches of one robot.

    Attributes:
        engine: policy, control, physics, observation, success.
        bare: mj_step with the recorded controls.
        robosuite: env.step and observation, on one core; NaN if it did not take part.
        threads: how many times faster two threads of the engine are than one.
        bare_threads: the same of bare mj_step: what the machine's two cores give.
        contacts, rows: means of the recorded states.
    """

    engine: float
    bare: float
    robosuite: float
    threads: float
    bare_threads: float
    contacts: float
    rows: float

    @property
    def share(self) -> float:
        """Share of the control rate that bare mj_step would allow."""
        return self.engine / self.bare

    @property
    def ratio(self) -> float:
        """Times robosuite's env.step."""
        return self.engine / self.robosuite


def race(make: Callable[[], Plant], actor: Actor, native: NativeRobot | None = None, rounds: int = ROUNDS) -> Race:
    """Time engine, bare mj_step, and robosuite if given, in turns over the stretches of one episode.

    Args:
        make: a new plant of the robot.
        actor: the policy.
        native: the same robot under robosuite.
        rounds: turns.
    """
    plant, other = make(), make()
    stretches = record(plant, actor)
    count = len(stretches.states)
    racers = {"engine": lambda i: _engine_time(plant, actor, stretches, i), "bare": lambda i: _bare_time(plant, stretches, i)}
    if native is not None:
        native.begin(RECORDED_SEED)
        racers["robosuite"] = lambda i: _robosuite_time(native, stretches, i)
    for racer in racers.values():
        racer(0)  # untimed: the first call may compile
    best = {name: np.full(count, np.inf) for name in racers}
    for _ in range(rounds):
        for i in range(count):
            for name, racer in racers.items():
                best[name][i] = min(best[name][i], racer(i))
    rate = {name: count * STRETCH / times.sum() for name, times in best.items()}
    runners = {
        "engine": lambda plant, i: _engine_time(plant, actor, stretches, i),
        "bare": lambda plant, i: _bare_time(plant, stretches, i),
    }
    walls = {name: np.full((2, count), np.inf) for name in runners}
    for _ in range(rounds):
        for i in range(count):
            for name, run in runners.items():
                for k, plants in enumerate(([plant], [plant, other])):
                    walls[name][k, i] = min(walls[name][k, i], _together(plants, run, i))
    gain = {name: 2 * alone.sum() / pair.sum() for name, (alone, pair) in walls.items()}
    robosuite = rate.get("robosuite", np.nan)
    return Race(rate["engine"], rate["bare"], robosuite, gain["engine"], gain["bare"], stretches.contacts, stretches.rows)


def _engine_time(plant: Plant, actor: Actor, stretches: Stretches, index: int) -> float:
    _stand(plant, stretches, index)
    rng, observation = np.random.default_rng(0), plant.observe()
    began = time.thread_time()
    played = play_on(plant, actor, rng, observation, STRETCH)
    return (time.thread_time() - began) * STRETCH / len(played.rewards)


def _bare_time(plant: Plant, stretches: Stretches, index: int) -> float:
    _stand(plant, stretches, index)
    began = time.thread_time()
    bare_steps(plant.model._address, plant.data._address, stretches.controls[index], plant.data.ctrl)
    return time.thread_time() - began


def _robosuite_time(native: NativeRobot, stretches: Stretches, index: int) -> float:
    _stand_natively(native, stretches, index)
    began = time.thread_time()
    for action in stretches.actions[index]:
        native.step(action)
    return time.thread_time() - began


def _together(plants: Sequence[Plant], play_stretch: Callable[[Plant, int], float], index: int) -> float:
    """Wall time [s] in which every plant plays one stretch, each in a thread of its own."""
    threads = [threading.Thread(target=play_stretch, args=(plant, index)) for plant in plants]
    began = time.perf_counter()
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return time.perf_counter() - began


def time_shares(plant: Plant, actor: Actor) -> dict[str, float]:
    """Where mj_step spends its time over an episode's stretches: part -> share, and "microseconds" per step."""
    stretches = record(plant, actor)
    timer = mujoco.mjtTimer
    total = np.zeros(timer.mjNTIMER)
    pointer = ctypes.c_void_p.in_dll(ctypes.CDLL(osc.library()), "mjcb_time")
    pointer.value = _microseconds.address
    try:
        for index in range(len(stretches.states)):
            rounds = []
            for _ in range(4):
                _stand(plant, stretches, index)
                plant.data.timer.duration[:] = 0.0
                bare_steps(plant.model._address, plant.data._address, stretches.controls[index], plant.data.ctrl)
                rounds.append(plant.data.timer.duration.copy())
            total += min(rounds, key=lambda durations: durations[timer.mjTIMER_STEP])
    finally:
        pointer.value = None
    step = total[timer.mjTIMER_STEP]
    parts = {
        "kinematics": (timer.mjTIMER_POS_KINEMATICS,), "inertia": (timer.mjTIMER_POS_INERTIA,),
        "collision": (timer.mjTIMER_POS_COLLISION,), "constraint rows": (timer.mjTIMER_POS_MAKE, timer.mjTIMER_POS_PROJECT),
        "velocity": (timer.mjTIMER_VELOCITY,), "constraint solver": (timer.mjTIMER_CONSTRAINT,),
    }
    shares = {name: float(sum(total[t] for t in timers) / step) for name, timers in parts.items()}
    microseconds = float(step / stretches.controls.shape[1] / len(stretches.states))
    return shares | {"rest": 1.0 - sum(shares.values()), "microseconds": microseconds}


# ---- the same motion -------------------------------------------------------------------------------------------------


def with_hand(robot: Robot, hand: Robot) -> Robot:
    """The arm of one system with the gripper of another."""
    return dataclasses.replace(robot, name=f"{robot.name}_with_{hand.gripper.name}", gripper=hand.gripper, source_of_policy=False)


def gentle_actions(seed: int, steps: int = 40) -> np.ndarray:
    """Random OSC deltas (steps, n_act) that carry the arm up and about in free air, fingers kept at their preshape or open."""
    rng = np.random.default_rng(seed)
    actions = np.full((steps, ACTION_SIZE), -1.0)
    actions[:, :6] = rng.uniform(-0.2, 0.2, (steps, 6))
    actions[:10, 2] += 0.4
    return actions


def qpos_difference(native: NativeRobot, plant: Plant, seed: int) -> tuple[float, float]:
    """Largest difference [rad, m] of arm joints, and of all joints, between env.step and the engine over 2 s of free motion."""
    native.begin(seed)
    plant.begin(seed)
    arm = NativeScene(native.model).arm_qpos
    worst = np.zeros(native.model.nq)
    for action in gentle_actions(seed):
        native.step(action)
        plant.step(action)
        worst = np.maximum(worst, np.abs(native.data.qpos - plant.data.qpos))
    return float(worst[arm].max()), float(worst.max())


def observation_difference(native: NativeRobot, plant: Plant, actor: Actor, seed: int, steps: int = 60) -> float:
    """Largest difference between the task's observation of robosuite's states and the engine's of the same states."""
    observation, rng = native.begin(seed), np.random.default_rng((seed, 1))
    plant.begin(seed)
    worst = float(np.abs(observation - plant.observe()).max())
    for _ in range(steps):
        observation = native.step(np.asarray(actor(observation, rng), float))
        plant.data.qpos[:], plant.data.qvel[:] = native.data.qpos, native.data.qvel
        mujoco.mj_kinematics(plant.model, plant.data)
        mujoco.mj_kinematics(native.model, native.data)
        plant.command = native.command.copy()
        worst = max(worst, float(np.abs(native.observe() - plant.observe()).max()))
    return worst


@dataclass(frozen=True)
class Outcomes:
    """How the same seeds end under the engine and under robosuite's env.step.

    Attributes:
        episodes: played by each.
        same: that end alike.
        engine, robosuite: successes.
    """

    episodes: int
    same: int
    engine: int
    robosuite: int


def _with(actor: Actor, rng: np.random.Generator, observation: np.ndarray) -> np.ndarray:
    return actor(observation, rng)


def outcomes(
    native: NativeRobot, plant: Plant, actor: Actor, seeds: Sequence[int], progress: Callable[[int], None] = lambda done: None
) -> Outcomes:
    """Play seeds by the engine and by env.step, with the policy's own noise drawn alike."""
    pairs = []
    for done, seed in enumerate(seeds, start=1):
        fast = play(plant, actor, seed, np.zeros(0)).success
        rng = np.random.default_rng((seed, 1))
        pairs.append((fast, native.play(partial(_with, actor, rng), seed)))
        progress(done)
    return Outcomes(len(pairs), sum(a == b for a, b in pairs), sum(a for a, _ in pairs), sum(b for _, b in pairs))


# ---- scale -----------------------------------------------------------------------------------------------------------


def episode_rate(merged: MergedRobot, actor: Actor, alphas: Sequence[np.ndarray], batch: int, threads: int) -> float:
    """Episodes per second [1/s], F(alpha) included, of batches on robots drawn in turn from ``alphas``."""
    engine = RolloutEngine(merged, threads)
    try:
        engine.play(actor, [alphas[0]], [0])
        robots = [alphas[i % len(alphas)] for i in range(batch)]
        began = time.perf_counter()
        engine.play(actor, robots, list(range(batch)))
        return batch / (time.perf_counter() - began)
    finally:
        engine.close()


def morph_seconds(merged: MergedRobot, alphas: Sequence[np.ndarray], rounds: int = 5) -> float:
    """Time [s] of F(alpha) with everything an episode needs of it."""
    model, data = merged.new()
    best = np.full(len(alphas), np.inf)
    for _ in range(rounds):
        for i, alpha in enumerate(alphas):
            began = time.perf_counter()
            merged_plant(merged, alpha, model, data)
            best[i] = min(best[i], time.perf_counter() - began)
    return float(best.mean())


def environment_bytes(merged: MergedRobot) -> int:
    """Memory of one environment: a model and its data. There is one per thread, whatever the batch."""
    model, data = merged.new()
    return int(mujoco.mj_sizeModel(model) + data.nbuffer + data.narena)


def machine_load() -> float:
    """Processes that ran or waited over the last minute."""
    return os.getloadavg()[0]


def processor() -> str:
    """What the machine calls its processor."""
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        text = ""
    named = re.search(r"^model name\s*:\s*(.+)$", text, re.MULTILINE)
    return named.group(1).strip() if named else platform.processor() or platform.machine()


# ---- all of it -------------------------------------------------------------------------------------------------------


def measure_engine(
    robots: Sequence[Robot], merged: MergedRobot, actor: Actor, episodes: int, rounds: int, scale: bool,
    progress: Callable[[str, str], None] = lambda title, detail: None,
) -> dict[str, Any]:
    """The contract of ``meta-evolve bench engine --json``.

    Args:
        robots: systems to measure as robosuite has them.
        merged: the merged robot.
        actor: the policy.
        episodes: compared for their ending; 0: none.
        rounds: turns of each racer.
        scale: whether to measure episodes per second.
        progress: called with what is being measured.
    """
    before = machine_load()
    return {
        "robots": [_measure_robot(robot, merged.task, actor, episodes, rounds, progress) for robot in robots],
        "merged": [_measure_merged(merged, name, actor, rounds, progress) for name in merged.space.matching.names],
        "scale": _measure_scale(merged, actor, progress) if scale else None,
        "machine": {"cores": len(os.sched_getaffinity(0)), "processor": processor(), "date": date.today().isoformat(),
                    "load_before": before, "load_after": machine_load()},
    }


def _measure_robot(
    robot: Robot, task: PickTask, actor: Actor, episodes: int, rounds: int, progress: Callable[[str, str], None]
) -> dict[str, Any]:
    progress(robot.name, "parity")
    native, plant = NativeRobot(robot, task), native_plant(robot, task)
    arm, whole = np.max([qpos_difference(native, plant, seed) for seed in (0, 1)], axis=0)
    observed = observation_difference(native, plant, actor, RECORDED_SEED)
    progress(robot.name, "speed")
    speed = race(lambda: native_plant(robot, task), actor, native, rounds)
    ended = outcomes(native, plant, actor, range(episodes), lambda done: progress(robot.name, f"{done} of {episodes} episodes"))
    return {
        "name": robot.name, "parity_qpos": float(arm), "parity_qpos_fingers": float(whole), "observation_error": observed,
        "control_steps_per_s": speed.engine, "robosuite_control_steps_per_s": speed.robosuite, "ratio_to_robosuite": speed.ratio,
        "ratio_to_bare_mj_step": speed.share, "bare_mj_step_ratio_to_robosuite": speed.bare / speed.robosuite,
        "ratio_of_two_threads": speed.threads, "bare_mj_step_ratio_of_two_threads": speed.bare_threads,
        "contacts": speed.contacts, "rows": speed.rows, "outcomes": dataclasses.asdict(ended),
    }


def _measure_merged(
    merged: MergedRobot, name: str, actor: Actor, rounds: int, progress: Callable[[str, str], None]
) -> dict[str, Any]:
    progress(f"F(beta) of {name}", "speed")
    make = lambda: merged_plant(merged, merged.space.beta(name), *merged.new())  # noqa: E731
    speed = race(make, actor, rounds=rounds)
    return {
        "name": name, "control_steps_per_s": speed.engine, "ratio_to_bare_mj_step": speed.share,
        "ratio_of_two_threads": speed.threads, "bare_mj_step_ratio_of_two_threads": speed.bare_threads,
        "contacts": speed.contacts, "rows": speed.rows, "mj_step": time_shares(make(), actor),
    }


def _measure_scale(merged: MergedRobot, actor: Actor, progress: Callable[[str, str], None]) -> dict[str, Any]:
    cores = len(os.sched_getaffinity(0))
    betas = merged.space.betas
    middles = [0.5 * (betas[0] + beta) for beta in betas[1:]]
    rows = []
    for batch, threads in [*((size, cores) for size in BATCHES), *((BATCHES[2], t) for t in range(1, cores))]:
        progress("scale", f"{batch} environments, {threads} threads")
        rate = episode_rate(merged, actor, middles, batch, threads)
        rows.append({"environments": batch, "threads": threads, "D": merged.space.size, "episodes_per_s": rate})
    systems = merged.space.matching.systems
    for count in range(2, len(systems)):
        smaller = MergedRobot(EvolutionSpace(match([system.robot for system in systems[:count]])), merged.task)
        progress("scale", f"D = {smaller.space.size}")
        middle = [0.5 * (smaller.space.betas[0] + smaller.space.betas[1])]
        rate = episode_rate(smaller, actor, middle, BATCHES[2], cores)
        rows.append({"environments": BATCHES[2], "threads": cores, "D": smaller.space.size, "episodes_per_s": rate})
    return {"episodes": rows, "morph_s": morph_seconds(merged, middles), "bytes_per_environment": environment_bytes(merged)}


def _percent(shares: dict[str, float], parts: list[str]) -> list[str]:
    return [f"{shares[part]:.0%}" for part in parts]


def performance_page(found: dict[str, Any], command: str) -> str:
    """The report of ``measure_engine`` as Markdown.

    Args:
        found: the report.
        command: that measured it.
    """
    machine, scale = found["machine"], found["scale"]
    lines = [
        "# Performance", "",
        f"Written by `{command}` on {machine['date']}, {machine['cores']} cores of {machine['processor']}; load "
        f"{machine['load_before']:.1f} before and {machine['load_after']:.1f} after, the command included. A control step is one action of "
        "the policy: 50 ms, 25 steps of physics. One thread is timed in processor time over contact-rich stretches of a real episode, the "
        "racers in turns; bare mj_step plays the engine's recorded controls, so all three move alike.", "",
        "## Unmodified robots", "",
        "| robot | control steps/s | of bare mj_step | of env.step | bare of env.step | two threads | bare on two threads | contacts "
        "| qpos off in 2 s | observation off | same endings |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {r['name']} | {r['control_steps_per_s']:.0f} | {r['ratio_to_bare_mj_step']:.2f} | {r['ratio_to_robosuite']:.1f} x "
        f"| {r['bare_mj_step_ratio_to_robosuite']:.1f} x | {r['ratio_of_two_threads']:.2f} x "
        f"| {r['bare_mj_step_ratio_of_two_threads']:.2f} x | {r['contacts']:.0f} | {r['parity_qpos']:.0e} rad "
        f"| {r['observation_error']:.0e} "
        f"| {r['outcomes']['same']} of {r['outcomes']['episodes']} |"
        for r in found["robots"]
    ]
    parts = [part for part in found["merged"][0]["mj_step"] if part != "microseconds"]
    lines += ["", "## The merged robot, and where its mj_step spends the time", "",
              f"| F(beta) of | control steps/s | of bare mj_step | us per mj_step | rows | {' | '.join(parts)} |",
              "|---|---|---|---|---|" + "---|" * len(parts)]
    lines += [
        f"| {r['name']} | {r['control_steps_per_s']:.0f} | {r['ratio_to_bare_mj_step']:.2f} | {r['mj_step']['microseconds']:.0f} "
        f"| {r['rows']:.0f} | {' | '.join(_percent(r['mj_step'], parts))} |"
        for r in found["merged"]
    ]
    if scale:
        lines += ["", "## Episodes", "", "| environments | threads | D | episodes/s |", "|---|---|---|---|"]
        lines += [f"| {row['environments']} | {row['threads']} | {row['D']} | {row['episodes_per_s']:.1f} |" for row in scale["episodes"]]
        lines += ["", f"F(alpha) is included; it takes {1e3 * scale['morph_s']:.1f} ms per episode. An environment takes "
                  f"{scale['bytes_per_environment'] / 2**20:.1f} MiB, and there is one per thread, whatever the batch."]
    return "\n".join(lines) + "\n"
