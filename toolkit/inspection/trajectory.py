"""Films: an episode played again with everything worth seeing, read from the simulation between its steps.

Playing again costs what playing cost; nothing is measured inside the physics loop, and the engine knows nothing of it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from tasks.pick import PickTask
from toolkit.simulation.laws import Drivable
from toolkit.simulation.plant import CLOSING
from toolkit.simulation.rollout import Actor, play
from toolkit.simulation.watching import Watcher


@dataclass(frozen=True, eq=False)
class Trajectory:
    """T steps, T + 1 frames.

    Attributes:
        model: that was played.
        body_pos, site_pos: (nbody, 3), (nsite, 3) [m] of the model in this episode: a scene may place what has no joint.
        qpos: (T + 1, nq) [m, rad].  actions: (T, n_act).  rewards: (T,).
        interval: [s] between frames.  horizon: steps after which an episode ends.
        success, diverged: how it ended.
    """

    model: mujoco.MjModel
    body_pos: np.ndarray
    site_pos: np.ndarray
    qpos: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray
    interval: float
    horizon: int
    success: bool
    diverged: bool

    def verdict(self) -> str:
        """How it ended, in words."""
        seconds = f"{len(self.rewards) * self.interval:.1f} s"
        if self.diverged:
            return "the simulation diverged"
        if self.success:
            return f"success after {seconds}"
        early = len(self.rewards) < self.horizon
        return f"failure: success became impossible after {seconds}" if early else f"failure: not done in {seconds}"


@dataclass(frozen=True, eq=False)
class PickTrajectory(Trajectory):
    """A film of an arm with a gripper that picks an object.

    Attributes:
        object_body: id of its object.
        grasp: (T + 1, 3) [m] grasp frame.  target: (T, 3) [m] where OSC pulled it during each step.
        carried: (T + 1, 3) [m] object.  goal: (3,) [m].
        closing: (T,) progress of the closing command, -1 to +1.
        points, forces: per step (k, 3) [m] and (k, 3) [N]: contacts of the object and the forces on it, world.
        by_robot: per step (k,) whether the robot touches (else the table).
    """

    object_body: int
    grasp: np.ndarray
    target: np.ndarray
    carried: np.ndarray
    goal: np.ndarray
    closing: np.ndarray
    points: list[np.ndarray]
    forces: list[np.ndarray]
    by_robot: list[np.ndarray]

    @property
    def distance(self) -> np.ndarray:
        """(T + 1,) [m] from object to goal."""
        return np.linalg.norm(self.carried - self.goal, axis=1)

    @property
    def grip(self) -> np.ndarray:
        """(T,) [N] sum of the normal and friction forces with which the robot holds or pushes the object."""
        return np.array([np.linalg.norm(f[r], axis=1).sum() for f, r in zip(self.forces, self.by_robot, strict=True)])

    def verdict(self) -> str:
        """How it ended, in words: the first of what may go wrong that did."""
        if self.diverged or self.success:
            return super().verdict()
        held = self.grip > 0
        lifted = self.carried[:, 2] - self.carried[0, 2]
        if not held.any():
            return "failure: the robot never touched the object"
        if lifted.max() < 0.03:
            return f"failure: touched, never lifted (grip at most {self.grip.max():.1f} N)"
        if lifted[-1] < 0.5 * lifted.max():
            when = self.interval * int(np.argmax(lifted))
            return f"failure: lifted {100 * lifted.max():.0f} cm, lost at {when:.1f} s"
        return f"failure: held, but ended {100 * self.distance[-1]:.0f} cm from the goal"


class _Recorder(Watcher):
    """Notes what happens between a robot's steps."""

    frames: tuple[str, ...] = ("qpos",)
    """What is noted at the beginning and after every step."""
    steps: tuple[str, ...] = ()
    """What is noted of every step."""

    def __init__(self) -> None:
        self.notes: dict[str, list] = {key: [] for key in (*self.frames, *self.steps)}

    def begun(self, plant: Drivable) -> None:
        self.notes["qpos"].append(np.array(plant.data.qpos))

    def acted(self, plant: Drivable) -> None:
        self.begun(plant)


class _PickRecorder(_Recorder):
    """Of an arm that picks an object."""

    frames = ("qpos", "grasp", "carried")
    steps = ("target", "closing", "points", "forces", "by_robot")
    object_body = -1

    def begun(self, plant: Any) -> None:
        super().begun(plant)
        self.object_body = int(plant.object_body)
        self.notes["grasp"].append(plant.grasp_position)
        self.notes["carried"].append(np.array(plant.object_position))

    def acting(self, plant: Any, action: np.ndarray) -> None:
        self.notes["target"].append(plant.aim(action))

    def acted(self, plant: Any) -> None:
        super().acted(plant)
        self.notes["closing"].append(plant.law.progress(plant.command))
        for key, value in zip(("points", "forces", "by_robot"), contacts_of(plant.model, plant.data, plant.object_body), strict=True):
            self.notes[key].append(value)


def replay(plant: Drivable, actor: Actor, seed: int, alpha: np.ndarray) -> Trajectory:
    """Play an episode again; of an arm at its table a PickTrajectory.

    Args:
        plant, actor, seed, alpha: as the episode had them.
    """
    recorder = _PickRecorder() if isinstance(plant.task, PickTask) else _Recorder()
    episode, notes = play(plant, actor, seed, alpha, recorder), recorder.notes
    sound = int(np.isfinite(np.array(notes["qpos"])).all(axis=1).cumprod().sum())  # frames before the first that is not finite
    frames = max(1, min(sound, episode.steps + 1))
    array: Callable[[str, int], np.ndarray] = lambda key, count: np.array(notes[key][:count])  # noqa: E731
    told = {
        "model": plant.model, "body_pos": np.array(plant.model.body_pos), "site_pos": np.array(plant.model.site_pos),
        "qpos": array("qpos", frames), "actions": episode.actions[: frames - 1], "rewards": episode.rewards[: frames - 1],
        "interval": 1.0 / plant.task.control_frequency, "horizon": plant.task.horizon, "success": episode.success,
        "diverged": episode.diverged,
    }
    if not isinstance(recorder, _PickRecorder):
        return Trajectory(**told)
    return PickTrajectory(
        **told, object_body=recorder.object_body, grasp=array("grasp", frames), target=array("target", frames - 1).reshape(-1, 3),
        carried=array("carried", frames), goal=np.array(plant.goal), closing=array("closing", frames - 1),
        points=notes["points"][: frames - 1], forces=notes["forces"][: frames - 1], by_robot=notes["by_robot"][: frames - 1],
    )


def contacts_of(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where a body is touched: points (k, 3) [m], forces on it (k, 3) [N], both world, and whether a jointed body does it."""
    points, forces, moving = [], [], []
    wrench = np.zeros(6)
    for index in range(data.ncon):
        contact = data.contact[index]
        bodies = [int(model.geom_bodyid[geom]) for geom in contact.geom]
        if body in bodies and contact.efc_address >= 0:
            mujoco.mj_contactForce(model, data, index, wrench)
            # The frame's rows are its axes; the first points from the first geom to the second, and so does the push.
            force = contact.frame.reshape(3, 3).T @ wrench[:3]
            other = bodies[1] if bodies[0] == body else bodies[0]
            points.append(np.array(contact.pos))
            forces.append(force if bodies[1] == body else -force)
            moving.append(model.body_weldid[other] != 0)
    return np.array(points).reshape(-1, 3), np.array(forces).reshape(-1, 3), np.array(moving, bool)


def closing_action(actions: np.ndarray) -> np.ndarray:
    """(T,) mean closing action of actions (T, n_act)."""
    return actions[:, 6:][:, CLOSING].mean(axis=1)
