"""A simulation that blew up: what its last policy step started from, in one inert file, and that step played again.

    play (rollout.py) -> Divergence -> one .npz without pickle -> replay, one step of physics after the other
"""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from tasks.npz import ArrayError, Arrays
from toolkit.errors import ToolkitError
from toolkit.io.jsonfiles import parsed_object, require
from toolkit.simulation.laws import Drivable
from toolkit.simulation.osc import STATE
from toolkit.simulation.plant import SPEED_LIMIT, WATCHED_WARNINGS

FORMAT = 1
"""Of the file."""
_ARRAYS = {"alpha": (None,), "state": (None,), "command": (None,), "goal": (3,), "actions": (None, None)}


@dataclass(frozen=True, eq=False)
class Divergence:
    """The policy step in which an episode's simulation blew up.

    Attributes:
        robots: names: the merged robot's, source first, or the one native robot.
        native: whether it was the unmodified robosuite robot.
        task: name.
        seed: of the episode.
        alpha: (D,) of the robot that played.
        state: (n_state,) mjSTATE_INTEGRATION before the step.
        command: (n_roles,) closing command before the step.
        goal: (3,) [m], world.
        actions: (T, n_act) of the whole episode; the last one is the step's.
    """

    robots: tuple[str, ...]
    native: bool
    task: str
    seed: int
    alpha: np.ndarray
    state: np.ndarray
    command: np.ndarray
    goal: np.ndarray
    actions: np.ndarray

    def save(self, path: Path) -> None:
        """Write one .npz, whole or not at all: arrays, and a JSON header for the names."""
        header = {"format": FORMAT, "robots": list(self.robots), "native": self.native, "task": self.task, "seed": self.seed,
                  "mujoco": mujoco.__version__}
        unfinished = path.with_suffix(".part")
        with open(unfinished, "wb") as file:
            np.savez_compressed(file, header=np.array(json.dumps(header)), **{name: getattr(self, name) for name in _ARRAYS})
        unfinished.replace(path)

    @classmethod
    def load(cls, path: Path) -> "Divergence":
        """Read a file that ``save`` wrote; nothing in it can run code.

        Raises:
            ToolkitError: no such file, or not one of ours.
        """
        if not path.is_file():
            raise ToolkitError(f"{path} does not exist; a run whose simulation blew up leaves divergence.npz in its folder")
        mend = "take the run's divergence.npz"
        try:
            with Arrays(path) as content:
                text = str(content.read("header", (), ("str",)))
                header = parsed_object(text, f"the header of {path}", mend)
                arrays = {name: content.read(name, shape, ("float64",), finite=False) for name, shape in _ARRAYS.items()}
        except ArrayError as error:
            raise ToolkitError(f"{path} is no divergence dump or is damaged ({error}); {mend}") from None
        require(header, {"format": int, "robots": [str], "native": bool, "task": str, "seed": int}, f"the header of {path}", mend)
        if header["format"] != FORMAT:
            raise ToolkitError(f"{path} has format {header['format']}; this version reads {FORMAT}")
        if not len(arrays["actions"]) or not header["robots"] or header["seed"] < 0:
            raise ToolkitError(f"{path} names no robot, no seed or no action, so it is damaged; {mend}")
        return cls(tuple(header["robots"]), header["native"], header["task"], header["seed"],
                   arrays["alpha"], arrays["state"], arrays["command"], arrays["goal"], arrays["actions"])

    @property
    def step(self) -> int:
        """Index of the policy step that blew up."""
        return len(self.actions) - 1


@dataclass(frozen=True)
class Substep:
    """One step of physics of a replayed policy step.

    Attributes:
        time: since the episode's start [s].
        joint: the fastest one, and its speed [rad/s or m/s].
        contacts: how many.
        penetration: of the deepest contact [m].
        torque: largest share of its limit that an arm joint's torque takes; NaN if a torque is no number.
        warnings: MuJoCo's, with the joint that each names.
    """

    time: float
    joint: str
    speed: float
    contacts: int
    penetration: float
    torque: float
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class Replay:
    """A divergence played again.

    Attributes:
        diverged: whether it blew up again.
        cause: one sentence: what, where, when.
        substeps: from the start of the policy step to where it blew up.
    """

    diverged: bool
    cause: str
    substeps: tuple[Substep, ...]

    def to_json(self) -> dict[str, Any]:
        """The contract of ``meta-evolve replay --json``; numbers that are none are null."""
        rows = [{key: None if isinstance(value, float) and not np.isfinite(value) else value for key, value in asdict(row).items()}
                for row in self.substeps]
        return {"diverged": self.diverged, "cause": self.cause, "substeps": rows}


def replay(plant: Drivable, divergence: Divergence) -> Replay:
    """Play the policy step of a dump again on its own robot, one step of physics at a time.

    Raises:
        ToolkitError: the dump is of another robot, or of a robot that has changed since.
    """
    model, data, action = plant.model, plant.data, divergence.actions[-1]
    wanted = {"state": mujoco.mj_stateSize(model, STATE), "command": plant.command.size, "goal": 3}
    found = {name: getattr(divergence, name).size for name in wanted}
    if wanted != found or action.size != len(plant.task.action.names):
        raise ToolkitError(f"the dump's sizes {found} are not {wanted} of {', '.join(divergence.robots)}; the robots have changed "
                           "since, so play it with the version that wrote it")
    plant.begin(divergence.seed)
    mujoco.mj_setState(model, data, divergence.state, STATE)
    plant.command, plant.goal = divergence.command.copy(), divergence.goal.copy()
    plant.set_command(action)
    rows = []
    for substep in range(plant.substeps):
        plant.play_substeps(action, 1, sets_goal=substep == 0)
        rows.append(_look(plant))
        if plant.diverged:
            break
    return Replay(plant.diverged or not np.isfinite(action).all(), _cause(divergence, rows, plant), tuple(rows))


def _look(plant: Drivable) -> Substep:
    model, data = plant.model, plant.data
    speeds = np.abs(data.qvel)
    fastest = int(np.argmax(np.where(np.isnan(speeds), np.inf, speeds)))
    warnings = [f"{mujoco.mjtWarning(int(w)).name} at {_named(model, int(w), data.warning[int(w)].lastinfo)}"
                for w in WATCHED_WARNINGS if data.warning[int(w)].number]
    depth = max((float(-contact.dist) for contact in data.contact), default=0.0)
    return Substep(float(data.time), _joint_of(model, fastest), float(speeds[fastest]), int(data.ncon), max(depth, 0.0),
                   plant.torque_share, tuple(warnings))


def _joint_of(model: mujoco.MjModel, dof: int) -> str:
    joint = int(model.dof_jntid[dof])
    return model.joint(joint).name or f"joint {joint}"


def _named(model: mujoco.MjModel, warning: int, index: int) -> str:
    """The element that a warning's index means: a body, an actuator, a coordinate or a degree of freedom."""
    kind = mujoco.mjtWarning
    if warning == kind.mjWARN_BADCTRL and 0 <= index < model.nu:
        return model.actuator(index).name or f"actuator {index}"
    if warning == kind.mjWARN_BADQPOS and 0 <= index < model.nq:
        owner = int(np.searchsorted(model.jnt_qposadr, index, side="right")) - 1
        return model.joint(owner).name or f"joint {owner}"
    return _joint_of(model, index) if 0 <= index < model.nv else f"index {index}"


def _cause(divergence: Divergence, rows: list[Substep], plant: Drivable) -> str:
    action = divergence.actions[-1]
    if not np.isfinite(action).all():
        entry = int(np.flatnonzero(~np.isfinite(action))[0])
        return f"the policy's action {entry} is {action[entry]} at policy step {divergence.step}"
    last = rows[-1]
    where = f"{last.time:.3f} s after the start, substep {len(rows)} of {plant.substeps} of policy step {divergence.step}"
    if last.warnings:
        return f"{last.warnings[0]}, {where}"
    if plant.diverged:
        return f"joint {last.joint} moves at {last.speed:.3g} rad/s or m/s (limit {SPEED_LIMIT:.0f}), {where}"
    return f"policy step {divergence.step} plays through here; another version or machine than the one that wrote the dump"
