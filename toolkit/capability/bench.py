"""What one robot can do, without any policy: how it grips, opens, closes, reaches and follows, and whether a script holds.

Everything is measured on F(alpha) in MuJoCo, arm and box clamped where it is the fingers that are asked.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import mujoco
import numpy as np

from grippers.gripper import COMMANDED_ROLES, THUMB
from tasks.pick import ACTION_SIZE, START_POSITION, START_ROTATION
from tasks.table import HAND_BIT
from toolkit.demonstrations.scripts import PickScript, pick_script
from toolkit.morphology.build import MergedRobot
from toolkit.morphology.linkage import BOX_HALF_SIZE, SETTLED, closed_on_box
from toolkit.runs.seeds import SCRIPT_SEEDS
from toolkit.simulation.laws import merged_plant
from toolkit.simulation.plant import Plant
from toolkit.simulation.rollout import play

WIDTHS = (0.03, 0.05, 0.07)
"""Widths [m] of the boxes that are gripped, beside the task's own object's."""
HALFWAY = 0.5
"""Share of its final force on the object's width at which a gripper counts as closed."""
LONGEST = 260
"""Policy steps after which a gripper that has not closed never will: robosuite's slowest takes 145."""
NOTHING = 0.2
"""Grip [N] below which nothing is held: where the forces act then means nothing."""
OPENEST = 0.2
"""Opening [m] of a gripper that has nothing on one side of the object."""
DELTAS, DELTA, COASTING = 6, 0.5, 6
"""Policy steps of an OSC delta along one axis, its size (1 is 0.05 m), and steps without any after it."""
DELTA_METRES = 0.05
"""[m] of robosuite's OSC_POSE per unit of action."""
GRASPS = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.008), (0.0, 0.0, -0.008), (0.0, 0.008, 0.0), (0.0, -0.008, 0.0))
"""Shifts [m] of the object in the scripted grasp: as scripted, deeper, shallower, and towards either side of the jaws."""
ASIDE = ((0.0, 0.0, 0.0), *(tuple(row) for row in 0.012 * np.vstack([np.eye(3), -np.eye(3)])))
"""The same where tolerance is asked: as far off as policies are that hold."""
LIFTS = (0.2, 0.8)
"""Closing progress from which it lifts: as scripted, and patiently, for fingers that come late."""
EARLY = -0.2
"""The same of a policy that lifts while its fingers still close: fingers that touch one after the other spin what they hold, then."""


@dataclass(frozen=True)
class Capability:
    """What a robot can do.

    Attributes:
        grip_n: [N], sum of the normal forces on a fixed box as wide as the task's object, 1.5 s after the full closing command.
        grip_by_width: width [m] -> the same on other boxes.
        balance: the weaker of the two sides' pressures across the jaws over the stronger, on the object's width.
        height_mm: where those forces act along the approach, above the box's middle.
        askew_nmm: moment [N mm] of the forces about the box's middle.
        opening_mm: between thumb and fingers at the start, beside the box.
        closing_steps: policy steps, told to close at once, to half of the grip; None: it never comes.
        reach_mm: of the lowest fingertip below the grasp frame, open or closed, whichever is lower.
        clearance_mm: of that fingertip over the table in the scripted grasp.
        tracking: share of a commanded OSC delta that the grasp frame moves, mean over three axes; None: not measured.
        overshoot: largest way back after the command has ended, as a share of the way.
        script: best success rate of a few scripted grasps; None: not tried.
        tolerance: mean success rate of scripted grasps that are off by as much as a policy's, half of which lift early; None: not tried.
    """

    grip_n: float
    grip_by_width: dict[float, float]
    balance: float
    height_mm: float
    askew_nmm: float
    opening_mm: float
    closing_steps: float | None
    reach_mm: float
    clearance_mm: float
    tracking: float | None = None
    overshoot: float | None = None
    script: float | None = None
    tolerance: float | None = None

    def to_json(self) -> dict[str, Any]:
        """As plain numbers, rounded to what they mean."""
        digits = {"grip_n": 2, "balance": 3, "height_mm": 1, "askew_nmm": 1, "opening_mm": 1, "reach_mm": 1, "clearance_mm": 1,
                  "tracking": 3, "overshoot": 3, "script": 3, "tolerance": 3, "closing_steps": 1}
        out: dict[str, Any] = {}
        for name, number in digits.items():
            value = getattr(self, name)
            out[name] = None if value is None else round(float(value), number)
        return out | {"grip_by_width": {f"{width:g}": round(float(force), 2) for width, force in self.grip_by_width.items()}}


Detail = Literal["closed", "promised", "whole"]
"""What is measured of a robot: what its closed gripper tells, a tenth of a second; also how long that takes to close, so that all that an
audit promises is there; or everything, four times as long."""


@dataclass(frozen=True)
class Squeeze:
    """Forces on a box: their sum [N], that of each side across the jaws [N], where they act (3,) [m], their moment (3,) [N m]."""

    total: float
    thumb: float
    fingers: float
    middle: np.ndarray
    moment: np.ndarray

    @property
    def balance(self) -> float:
        """The weaker side's pressure over the stronger's."""
        return min(self.thumb, self.fingers) / max(self.thumb, self.fingers, 1e-9)


def _no_targets(command: float) -> np.ndarray:
    """For a hand that is not moved: no target."""
    return np.zeros(0)


class Bench:
    """Measures robots of one merged robot, one after the other.

    Args:
        merged: the merged robot in its task.
    """

    def __init__(self, merged: MergedRobot) -> None:
        self.merged = merged
        self._model, self._data = merged.new()
        slots, matching = merged.space.matching.slots, merged.space.matching
        self._arm = [self._model.joint(slot.name).id for slot in slots[: matching.arm_size]]
        self._fingers = [self._model.actuator(slots[i].name).id for i in merged.driven]
        self._item = self._model.body("object").id
        thumbs = {slot.name for slot in slots if slot.element == THUMB.name}
        fingers = {slot.name for slot in slots[matching.arm_size :]} - thumbs
        names = [self._model.body(int(body)).name for body in self._model.geom_bodyid]
        self._of_thumb = np.array([name in thumbs for name in names])
        self._of_finger = np.array([name in fingers for name in names])
        self.width = merged.task.object.width

    def measure(self, alpha: np.ndarray, episodes: int = 0, detail: Detail = "whole") -> Capability:
        """What F(alpha) can do, alpha (D,), in that detail; the script plays ``episodes`` per grasp, 0: it is not tried."""
        plant = merged_plant(self.merged, alpha, self._model, self._data)
        plant.begin(0)
        squeezed, closed = self.squeeze(plant, self.width)
        reach = max(self._reach(plant.model, plant.data), self._reach(*closed))
        script = pick_script(self.merged.task.object)
        found = Capability(
            grip_n=squeezed.total,
            grip_by_width={width: self.squeeze(plant, width)[0].total for width in WIDTHS} if detail == "whole" else {},
            balance=squeezed.balance,
            height_mm=1e3 * squeezed.middle[2],
            askew_nmm=1e3 * float(np.linalg.norm(squeezed.moment)),
            opening_mm=1e3 * self._opening(plant),
            closing_steps=None if detail == "closed" else self._closing(plant, squeezed.total),
            reach_mm=1e3 * reach,
            clearance_mm=1e3 * (self.merged.task.object.half_height - script.object_from_grasp[2] - reach),
            **(self._following(plant) if detail == "whole" else {}),
        )
        if episodes == 0:
            return found
        return replace(found, script=self.script(alpha, episodes), tolerance=self.tolerance(alpha, episodes))

    def quantity(self, alpha: np.ndarray, name: str, episodes: int) -> float | None:
        """One quantity of F(alpha) by itself, as ``measure`` would give it."""
        if name in ("script", "tolerance"):
            return (self.script if name == "script" else self.tolerance)(alpha, episodes)
        plant = merged_plant(self.merged, alpha, self._model, self._data)
        plant.begin(0)
        if name == "opening_mm":
            return 1e3 * self._opening(plant)
        squeezed, _ = self.squeeze(plant, self.width)
        if name == "closing_steps":
            return self._closing(plant, squeezed.total)
        return {"grip_n": squeezed.total, "balance": squeezed.balance, "height_mm": 1e3 * squeezed.middle[2]}[name]

    # ---- the fingers ---------------------------------------------------------------------------------------------

    def squeeze(self, plant: Plant, width: float) -> tuple[Squeeze, tuple[mujoco.MjModel, mujoco.MjData]]:
        """Forces on a fixed box ``width`` [m] wide, averaged, and the bench with the gripper closed on it."""
        law = plant.law

        def targets(command: float) -> np.ndarray:
            return law.targets(np.full(len(COMMANDED_ROLES), command))

        model, data = closed_on_box(plant.model, plant.start, self._arm, self._item, self._fingers, targets, law.preshape, width)
        samples = int(round(SETTLED / model.opt.timestep))
        rows = np.zeros((samples, 9))
        for row in rows:
            mujoco.mj_step(model, data)
            row[:] = self._forces(model, data)
        total, thumb, fingers, *rest = rows.mean(axis=0)
        return Squeeze(total, thumb, fingers, np.array(rest[:3]) / max(total, NOTHING), np.array(rest[3:])), (model, data)

    def _forces(self, model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
        """(9,): sum, thumb's and fingers' pressure across the jaws [N], sum of force times place [N m], moment [N m]."""
        out, wrench, closing = np.zeros(9), np.zeros(6), START_ROTATION[:, 0]
        for index in np.flatnonzero(np.any(model.geom_bodyid[data.contact.geom] == self._item, axis=1)):
            contact = data.contact[index]
            second = model.geom_bodyid[contact.geom[1]] == self._item
            mujoco.mj_contactForce(model, data, index, wrench)
            push = contact.frame[:3] * wrench[0] * (1.0 if second else -1.0)
            place = contact.pos - START_POSITION
            across = float(push @ closing)
            out[0] += abs(wrench[0])
            out[1 if across < 0 else 2] += abs(across)
            out[3:6] += abs(wrench[0]) * place
            out[6:] += np.cross(place, push)
        return out

    def _closing(self, plant: Plant, grip: float) -> float | None:
        """Policy steps until the grip on the object's width is half of what it will be; None: it never comes to that."""
        if grip < NOTHING:
            return None
        law = plant.law
        model, data = closed_on_box(plant.model, plant.start, self._arm, self._item, self._fingers, _no_targets,
                                    law.preshape, self.width, steps=0)
        state, close = np.full(plant.command.shape, law.preshape), np.ones(plant.command.shape)
        for step in range(LONGEST):
            state = law.advance(state, close)
            data.ctrl[self._fingers] = law.targets(state)
            mujoco.mj_step(model, data, plant.substeps)
            if data.ncon and self._forces(model, data)[0] >= HALFWAY * grip:
                return float(step + 1)
        return None

    def _extents(self, model: mujoco.MjModel, data: mujoco.MjData) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Fingers' geoms that touch: their ids, their centres from the grasp frame's start and reach (n, 3) [m] along world axes."""
        touching = np.flatnonzero((self._of_thumb | self._of_finger) & (model.geom_contype == HAND_BIT))
        frames, size = np.abs(data.geom_xmat[touching].reshape(-1, 3, 3)), model.geom_size[touching]
        box = model.geom_type[touching] == mujoco.mjtGeom.mjGEOM_BOX
        reach = np.where(box[:, None], np.einsum("nij,nj->ni", frames, size), frames[:, :, 2] * size[:, 1:2] + size[:, :1])
        return touching, data.geom_xpos[touching] - START_POSITION, reach

    def _opening(self, plant: Plant) -> float:
        """Distance [m] between the thumb and the other fingers at the start, where they stand beside the box."""
        mujoco.mj_forward(plant.model, plant.data)
        geoms, centre, reach = self._extents(plant.model, plant.data)
        beside = np.all(np.abs(centre[:, ::2]) < reach[:, ::2] + np.array(BOX_HALF_SIZE)[::2], axis=1)
        across = START_ROTATION[:, 0]
        out = 0.0
        for mask, side in ((self._of_thumb, 1.0), (self._of_finger, -1.0)):
            mine = beside & mask[geoms]
            gaps = side * (centre[mine] @ across) - reach[mine] @ np.abs(across)
            out += min(float(gaps.min()) if mine.any() else OPENEST / 2, OPENEST / 2)
        return out

    def _reach(self, model: mujoco.MjModel, data: mujoco.MjData) -> float:
        """How far [m] the lowest finger reaches below the grasp frame."""
        _, centre, reach = self._extents(model, data)
        return float((reach[:, 2] - centre[:, 2]).max(initial=0.0))

    # ---- the arm, and both ---------------------------------------------------------------------------------------

    @staticmethod
    def _following(plant: Plant) -> dict[str, float]:
        """``tracking`` and ``overshoot`` of an OSC delta along each axis in free air."""
        shares, back = [], []
        for axis in range(3):
            plant.begin(0)
            start, way = plant.grasp_position[axis], []
            for step in range(DELTAS + COASTING):
                action = np.full(ACTION_SIZE, -1.0)
                action[:6] = 0.0
                action[axis] = DELTA if step < DELTAS else 0.0
                plant.step(action)
                way.append(plant.grasp_position[axis] - start)
            shares.append(way[DELTAS - 1] / (DELTAS * DELTA * DELTA_METRES))
            back.append((max(way) - way[-1]) / max(max(way), 1e-6))
        return {"tracking": float(np.mean(shares)), "overshoot": float(np.max(back))}

    def script(self, alpha: np.ndarray, episodes: int) -> float:
        """Best success rate of a few scripted grasps, ``episodes`` each, the same starts for every robot; the first whole one ends it."""
        best = 0.0
        for shift in GRASPS:
            for patience in LIFTS:
                held = self._held(alpha, self._scripted(shift, patience), episodes, best)
                best = max(best, held)
                if best == 1.0:
                    return best
        return best

    def tolerance(self, alpha: np.ndarray, episodes: int) -> float:
        """Mean success rate of scripted grasps that are aside, and early, ``episodes`` each, the same starts for every robot.

        A script that waits for all fingers and takes the best of its grasps holds on robots that no policy can use.
        """
        grasps = [self._scripted(shift, lift) for shift in ASIDE for lift in (EARLY, LIFTS[0])]
        return float(np.mean([self._held(alpha, grasp, episodes, -1.0) for grasp in grasps]))

    def _scripted(self, shift: Sequence[float], lift: float) -> PickScript:
        """The task's script with the object elsewhere in its grasp by ``shift`` (3,) [m], that lifts from that closing progress on."""
        base = pick_script(self.merged.task.object)
        return replace(base, object_from_grasp=tuple(np.add(base.object_from_grasp, shift)), lift_from=lift)

    def _held(self, alpha: np.ndarray, script: PickScript, episodes: int, best: float) -> float:
        """Success rate of one scripted grasp; given up once it cannot pass ``best``."""
        plant = merged_plant(self.merged, alpha, self._model, self._data)
        held = 0
        for episode in range(episodes):
            if held + episodes - episode <= best * episodes:
                return held / episodes
            held += play(plant, script, SCRIPT_SEEDS + episode, alpha).success
        return held / episodes
