"""Kinematic trees: a robot as a Pinocchio model, built joint by joint from its compiled mjModel.

pin.buildModelFromMJCF returns an empty model for robosuite scenes, so the tree is assembled from what MuJoCo compiled.
"""

from collections.abc import Collection
from dataclasses import dataclass

import mujoco
import numpy as np
import pinocchio as pin

from toolkit.errors import ToolkitError


def _placement(position: np.ndarray, quaternion: np.ndarray) -> pin.SE3:
    w, x, y, z = quaternion
    return pin.SE3(pin.Quaternion(w, x, y, z).normalized().toRotationMatrix(), np.array(position))


def _inertia(model: mujoco.MjModel, body: int) -> pin.Inertia:
    rotation = _placement(np.zeros(3), model.body_iquat[body]).rotation
    tensor = rotation @ np.diag(model.body_inertia[body]) @ rotation.T
    return pin.Inertia(float(model.body_mass[body]), np.array(model.body_ipos[body]), tensor)


@dataclass(frozen=True)
class Screw:
    """A joint with its link at one configuration, in world axes.

    Attributes:
        anchor: a point on the joint axis (3,) [m].
        axis: unit vector (3,).
        mass: of the link and everything rigidly fixed to it [kg].
        com: its centre of mass (3,) [m].
        inertia: about the centre of mass (3, 3) [kg m^2].
        sliding: whether the link slides along the axis instead of turning about it.
    """

    anchor: np.ndarray
    axis: np.ndarray
    mass: float
    com: np.ndarray
    inertia: np.ndarray
    sliding: bool = False


class KinematicTree:
    """Joints, placements and lumped inertias of one robot.

    Args:
        model: a compiled scene.
        root: name of the robot's root body, fixed to the world.
        apart: bodies without joints that shall be links of their own, not lumped into what carries them; see ``welded``.

    Attributes:
        pin_model: the Pinocchio model; bodies without joints are lumped into the joint that carries them.
        joints: MuJoCo joint ids in Pinocchio's order (parents first).
    """

    def __init__(self, model: mujoco.MjModel, root: str, apart: Collection[int] = ()) -> None:
        self.pin_model = pin.Model()
        self.joints: list[int] = []
        self._axes: list[np.ndarray] = []
        self._sliding: list[bool] = []
        self._apart: dict[int, pin.Inertia] = {body: pin.Inertia.Zero() for body in apart}
        self._belongs: dict[int, int] = {}
        self._reference = np.array(model.qpos0)
        self._qpos_address = np.array(model.jnt_qposadr)
        root_id = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, root)
        if root_id < 0:
            raise ToolkitError(f"the model has no body {root!r} to root the kinematic tree at")
        carriers: dict[int, tuple[int, pin.SE3]] = {int(model.body_parentid[root_id]): (0, pin.SE3.Identity())}
        self.bodies: dict[int, tuple[int, pin.SE3]] = {}
        for body in range(root_id, model.nbody):
            parent = int(model.body_parentid[body])
            if model.body_rootid[body] == model.body_rootid[root_id] and parent in carriers:
                carriers[body] = self.bodies[body] = self._add_body(model, body, carriers[parent])
        self.pin_data = self.pin_model.createData()

    def _add_body(self, model: mujoco.MjModel, body: int, carrier: tuple[int, pin.SE3]) -> tuple[int, pin.SE3]:
        """Append a body with its joints; returns the carrying Pinocchio joint and the body's placement in it."""
        joint_id, placement = carrier
        placement = placement * _placement(model.body_pos[body], model.body_quat[body])
        first = int(model.body_jntadr[body])
        for joint in range(first, first + int(model.body_jntnum[body])) if first >= 0 else []:
            kinds = {
                mujoco.mjtJoint.mjJNT_HINGE: pin.JointModelRevoluteUnaligned,
                mujoco.mjtJoint.mjJNT_SLIDE: pin.JointModelPrismaticUnaligned,
            }
            kind = kinds.get(mujoco.mjtJoint(model.jnt_type[joint]))
            if kind is None:
                raise ToolkitError(f"joint {model.joint(joint).name!r} is neither hinge nor slide; trees need those")
            axis, anchor = np.array(model.jnt_axis[joint]), pin.SE3(np.eye(3), np.array(model.jnt_pos[joint]))
            joint_id = self.pin_model.addJoint(joint_id, kind(axis), placement * anchor, model.joint(joint).name)
            placement = anchor.inverse()
            self.joints.append(joint)
            self._axes.append(axis)
            self._sliding.append(bool(model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE))
        link = body if body in self._apart else self._belongs.get(int(model.body_parentid[body])) if first < 0 else None
        if link is None:
            self.pin_model.appendBodyToJoint(joint_id, _inertia(model, body), placement)
        else:
            self._belongs[body] = link
            self._apart[link] += placement.act(_inertia(model, body))
        return joint_id, placement

    @property
    def names(self) -> list[str]:
        """MuJoCo joint names, in Pinocchio's order."""
        return list(self.pin_model.names)[1:]

    def parent(self, joint: int) -> int:
        """Index into ``joints`` of the parent of the joint at that index; -1 for the first of a chain."""
        return int(self.pin_model.parents[joint + 1]) - 1

    def configuration(self, qpos: np.ndarray) -> np.ndarray:
        """Pinocchio configuration (n,) from a MuJoCo qpos (nq,): MuJoCo's joint angles count from qpos0."""
        address = self._qpos_address[self.joints]
        return qpos[address] - self._reference[address]

    def screws(self, qpos: np.ndarray) -> list[Screw]:
        """Every joint with its link at a configuration ``qpos`` (nq,), in world axes, in the order of ``joints``."""
        pin.forwardKinematics(self.pin_model, self.pin_data, self.configuration(qpos))
        out = []
        for index, axis in enumerate(self._axes):
            placement = self.pin_data.oMi[index + 1]
            link = placement.act(self.pin_model.inertias[index + 1])
            out.append(
                Screw(
                    np.array(placement.translation), placement.rotation @ axis,
                    float(link.mass), np.array(link.lever), np.array(link.inertia), self._sliding[index],
                )
            )
        return out

    def welded(self, body: int, qpos: np.ndarray, axis: np.ndarray) -> Screw:
        """A body kept ``apart`` with all that is fixed to it, as the link of a joint at its origin that never moves.

        Args:
            body: its MuJoCo id.
            qpos: configuration (nq,).
            axis: of the joint (3,), which means nothing as long as it is held.
        """
        origin = self.body_placement(body, qpos).translation
        link = self.pin_data.oMi[self.bodies[body][0]].act(self._apart[body])
        return Screw(np.array(origin), axis, float(link.mass), np.array(link.lever), np.array(link.inertia))

    def body_placement(self, body: int, qpos: np.ndarray) -> pin.SE3:
        """World placement of a MuJoCo body at a configuration ``qpos`` (nq,)."""
        pin.forwardKinematics(self.pin_model, self.pin_data, self.configuration(qpos))
        joint_id, placement = self.bodies[body]
        return self.pin_data.oMi[joint_id] * placement

    def mass_matrix(self, qpos: np.ndarray) -> np.ndarray:
        """Joint-space inertia (n, n) without armature, in the order of ``joints``."""
        upper = pin.crba(self.pin_model, self.pin_data, self.configuration(qpos))
        return np.triu(upper) + np.triu(upper, 1).T
