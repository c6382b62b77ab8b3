"""robot.xml at work: where the grasp frame is, how high the gripper hangs, and joint speeds for a wanted motion (mink)."""

from collections.abc import Sequence

import mink
import mujoco
import numpy as np

from toolkit.bundle.manifest import Manifest
from toolkit.errors import ToolkitError

POSTURE_COST = 0.02
"""Weight of the start posture beside the grasp frame's pose: it settles the redundant joint, as robosuite's null space does."""
HULL = " hull"
"""Ends the name of the convex hull of a shape of the gripper, which stands for it in heights."""
COLLISION_GAIN, COLLISION_GAP, COLLISION_SIGHT = 0.3, 0.005, 0.08
"""Share of a gap that may be closed per tick; the gap [m] that stays; the distance [m] from which pairs are watched."""
PAIRS_WATCHED = 16
"""Collision pairs watched at most, those closest at the start first: a tick must stay short."""


def rotation_of(vector: np.ndarray) -> np.ndarray:
    """Rotation matrix (3, 3) of a rotation vector (3,) [rad]."""
    quaternion, out = np.empty(4), np.empty(9)
    angle = float(np.sqrt(vector @ vector))
    mujoco.mju_axisAngle2Quat(quaternion, vector / angle if angle > 1e-12 else np.array([1.0, 0.0, 0.0]), angle)
    mujoco.mju_quat2Mat(out, quaternion)
    return out.reshape(3, 3)


def vector_of(rotation: np.ndarray) -> np.ndarray:
    """Rotation vector (3,) [rad] of a rotation matrix (3, 3)."""
    out = np.empty(3)
    mujoco.mju_quat2Vel(out, quaternion_of(rotation), 1.0)
    return out


def quaternion_of(rotation: np.ndarray) -> np.ndarray:
    """Unit quaternion (4,), w first and not negative, of a rotation matrix (3, 3)."""
    out = np.empty(4)
    mujoco.mju_mat2Quat(out, np.ascontiguousarray(rotation).ravel())
    return out if out[0] >= 0 else -out


def quaternions_of(vectors: np.ndarray) -> np.ndarray:
    """Unit quaternions (k, 4), w first, of rotation vectors (k, 3) [rad]; continuous in the vector."""
    half = 0.5 * np.sqrt((vectors**2).sum(axis=1))
    return np.column_stack([np.cos(half), 0.5 * np.sinc(half / np.pi)[:, None] * vectors])


def sandwich(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Matrix (4, 4) that takes a quaternion q, w first, to the product left q right."""
    columns = np.empty((4, 4))
    for row, unit in zip(columns, np.eye(4), strict=True):
        mujoco.mju_mulQuat(row, left, unit)
        mujoco.mju_mulQuat(row, row.copy(), right)
    return columns.T


def matrix_of(quaternion: np.ndarray) -> np.ndarray:
    """Rotation matrix (3, 3) of a unit quaternion (4,), w first."""
    out = np.empty(9)
    mujoco.mju_quat2Mat(out, np.asarray(quaternion, float))
    return out.reshape(3, 3)


class Kinematics:
    """Forward kinematics of a bundle's robot, in the task frame.

    Args:
        mjcf: robot.xml.
        joints, fingers: names of the arm's and the gripper's joints, in the order of ``place``.
        flange: body that carries the gripper.
        start_rotation: (3, 3) of the grasp frame at the start.

    Raises:
        ToolkitError: MuJoCo does not load it, or it lacks a joint, the flange or the grasp frame.
    """

    def __init__(self, mjcf: str, joints: Sequence[str], fingers: Sequence[str], flange: str, start_rotation: np.ndarray) -> None:
        self.model = model = load_mjcf(mjcf)
        self.data = mujoco.MjData(model)
        self._arm, self._fingers = self._addresses(joints), self._addresses(fingers)
        self.start_rotation = np.array(start_rotation)
        self._coordinates: np.ndarray | None = None
        self._lowest: float | None = None
        try:
            self._site, wrist = model.site("grasp").id, int(model.body(flange).id)
        except KeyError as error:
            raise ToolkitError(f"robot.xml does not fit the manifest ({error}); export the bundle again") from None
        hung = {wrist}
        for body in range(wrist + 1, model.nbody):
            if model.body_parentid[body] in hung:
                hung.add(body)
        self._extent = _Extent(model, [g for g in range(model.ngeom) if model.geom_bodyid[g] in hung])

    @classmethod
    def of(cls, manifest: Manifest, mjcf: str) -> "Kinematics":
        """Of a bundle."""
        rotation = matrix_of(np.array(manifest.start.grasp_quaternion))
        joints = [joint.name for joint in manifest.joints]
        return cls(mjcf, joints, manifest.gripper.joints, manifest.robot.flange_body, rotation)

    def _addresses(self, names: Sequence[str]) -> np.ndarray:
        for name in names:
            if mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_JOINT, name) < 0:
                raise ToolkitError(f"robot.xml has no joint {name!r}, which the manifest names; export the bundle again")
        return np.array([int(self.model.jnt_qposadr[self.model.joint(name).id]) for name in names], int)

    def place(self, joints: np.ndarray, fingers: np.ndarray) -> None:
        """Set arm (n,) and finger (m,) angles [rad], in the manifest's order."""
        self.data.qpos[self._arm], self.data.qpos[self._fingers] = joints, fingers
        mujoco.mj_kinematics(self.model, self.data)
        self._coordinates = self._lowest = None

    @property
    def position(self) -> np.ndarray:
        """Origin (3,) [m] of the grasp frame."""
        return self.data.site_xpos[self._site].copy()

    @property
    def rotation(self) -> np.ndarray:
        """Rotation (3, 3) of the grasp frame."""
        return self.data.site_xmat[self._site].reshape(3, 3).copy()

    def coordinates(self) -> np.ndarray:
        """(6,) origin [m] of the grasp frame, and rotation vector [rad] from the start rotation."""
        if self._coordinates is None:
            self._coordinates = np.concatenate([self.position, vector_of(self.rotation @ self.start_rotation.T)])
        return self._coordinates.copy()

    def lowest(self) -> float:
        """Height [m] of the lowest point of what hangs on the flange."""
        if self._lowest is None:
            self._lowest = self._extent.lowest(self.data)
        return self._lowest


class _Extent:
    """Lowest point of hulls, boxes, capsules, cylinders, spheres and ellipsoids, all at once.

    A hull's lowest point is a vertex. The others reach |R z| . (half size along their axes) below their centres; balls and round
    ends add a radius, rims a share of one.
    """

    def __init__(self, model: mujoco.MjModel, geoms: list[int]) -> None:
        kinds = mujoco.mjtGeom
        hulls = np.array([g for g in geoms if model.geom_type[g] == kinds.mjGEOM_MESH], int)
        named = {model.geom(g).name.removesuffix(HULL) for g in hulls}
        starts, counts = (getattr(model, key)[model.geom_dataid[hulls]] for key in ("mesh_vertadr", "mesh_vertnum"))
        self._points = [np.array(model.mesh_vert[start : start + count], float) for start, count in zip(starts, counts, strict=True)]
        self._hulls, self._radius = hulls, model.geom_rbound[hulls]
        self._geoms = np.array([g for g in geoms if g not in hulls and model.geom(g).name not in named], int)
        size, kind = model.geom_size[self._geoms], model.geom_type[self._geoms]
        long = (kind == kinds.mjGEOM_CAPSULE) | (kind == kinds.mjGEOM_CYLINDER)
        self._half = np.where((kind == kinds.mjGEOM_BOX)[:, None], size, 0.0)
        self._half[long, 2] = size[long, 1]
        self._ball = np.where((kind == kinds.mjGEOM_SPHERE) | (kind == kinds.mjGEOM_CAPSULE), size[:, 0], 0.0)
        self._rim = np.where(kind == kinds.mjGEOM_CYLINDER, size[:, 0], 0.0)
        self._ellipsoid = np.where((kind == kinds.mjGEOM_ELLIPSOID)[:, None], size, 0.0)

    def lowest(self, data: mujoco.MjData) -> float:
        rows, heights = data.geom_xmat[:, 6:9], data.geom_xpos[:, 2]  # third row of a rotation: share of each axis along z
        bounds, lowest = heights[self._hulls] - self._radius, np.inf
        for hull in np.argsort(bounds):
            if bounds[hull] >= lowest:  # no point of this one, nor of those that follow, hangs lower
                break
            geom = self._hulls[hull]
            lowest = min(lowest, float(heights[geom] + (self._points[hull] @ rows[geom]).min()))
        down = np.abs(rows[self._geoms])
        reach = (down * self._half).sum(1) + self._ball
        if self._rim.any():
            reach += np.sqrt(np.maximum(1.0 - down[:, 2] ** 2, 0.0)) * self._rim
        if self._ellipsoid.any():
            reach += np.sqrt(((down * self._ellipsoid) ** 2).sum(1))
        return min(lowest, float((heights[self._geoms] - reach).min(initial=np.inf)))


def load_mjcf(mjcf: str) -> mujoco.MjModel:
    """A model of a bundle's robot.xml; nothing but the text itself is read.

    Raises:
        ToolkitError: no MJCF, or one that asks for other files.
    """
    for word in ("<include", "<plugin", "<extension", "file="):
        if word in mjcf:
            raise ToolkitError(f"robot.xml holds {word!r}, so it is none that an export wrote; export the bundle again")
    try:
        return mujoco.MjModel.from_xml_string(mjcf)
    except ValueError as error:
        raise ToolkitError(f"robot.xml does not load in MuJoCo ({error}); export the bundle again") from None


class JointSolver:
    """Joint speeds that move the grasp frame as wanted, within joint limits and clear of table and self (mink).

    Args:
        manifest: of the bundle.
        mjcf: its robot.xml.
        played: (T, n) arm angles of the golden episode [rad]; pairs of shapes that come together in it are not watched,
            as enclosing shapes of neighbours overlap.
    """

    def __init__(self, manifest: Manifest, mjcf: str, played: np.ndarray) -> None:
        self.manifest = manifest
        self.model = _arm_only(manifest, mjcf)
        self.period = 1.0 / manifest.policy_hz
        self.configuration = mink.Configuration(self.model)
        self._site = self.model.site("grasp").id
        self._frame = mink.FrameTask("grasp", "site", position_cost=1.0, orientation_cost=0.3, lm_damping=1e-4)
        self._posture = mink.PostureTask(self.model, cost=POSTURE_COST)
        self._posture.set_target(np.array(manifest.start.arm_rad))
        self.pairs = self._far_pairs(played)
        speeds = {joint.name: joint.speed for joint in manifest.joints}
        self._limits: list[mink.Limit] = [mink.ConfigurationLimit(self.model), mink.VelocityLimit(self.model, speeds)]
        if self.pairs:
            self._limits.append(
                mink.CollisionAvoidanceLimit(
                    self.model, [([a], [b]) for a, b in self.pairs], gain=COLLISION_GAIN,
                    minimum_distance_from_collisions=COLLISION_GAP, collision_detection_distance=COLLISION_SIGHT,
                )
            )

    def _far_pairs(self, played: np.ndarray) -> list[tuple[int, int]]:
        """Pairs of shapes on different, not neighbouring links that stay apart over the played episode."""
        model, data = self.model, mujoco.MjData(self.model)
        limit = mink.CollisionAvoidanceLimit(model, [(list(range(model.ngeom)), list(range(model.ngeom)))])
        closest = {pair: np.inf for pair in limit.geom_id_pairs}
        for row in played[:: max(1, len(played) // 12)]:
            data.qpos[:] = row
            mujoco.mj_kinematics(model, data)
            for pair in closest:
                closest[pair] = min(closest[pair], mujoco.mj_geomDistance(model, data, *pair, 1.0, None))
        apart = [pair for pair, gap in closest.items() if gap > 2 * COLLISION_GAP]
        return sorted(apart, key=lambda pair: (closest[pair], pair))[:PAIRS_WATCHED]

    def pose(self, joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Position (3,) [m] and rotation (3, 3) of the grasp frame at arm angles (n,)."""
        self._update(joints)
        data = self.configuration.data
        return data.site_xpos[self._site].copy(), data.site_xmat[self._site].reshape(3, 3).copy()

    def _update(self, joints: np.ndarray) -> None:
        if not np.array_equal(self.configuration.data.qpos, joints):  # asked at the same angles several times a tick
            self.configuration.update(joints)

    def solve(self, joints: np.ndarray, position: np.ndarray, rotation: np.ndarray) -> np.ndarray:
        """Joint speeds (n,) [rad/s] that bring the grasp frame to a pose within one period; zero where no speed is safe."""
        self._update(joints)
        self._frame.set_target(mink.SE3(np.concatenate([quaternion_of(rotation), position])))
        try:
            return mink.solve_ik(
                self.configuration, [self._frame, self._posture], self.period, "daqp", damping=1e-6, limits=self._limits
            )
        except mink.NoSolutionFound:
            return np.zeros(self.model.nv)


def _arm_only(manifest: Manifest, mjcf: str) -> mujoco.MjModel:
    """The robot with its fingers welded at their start angles."""
    model = load_mjcf(mjcf)
    data = mujoco.MjData(model)
    for name, angle in manifest.start.fingers.items():
        data.qpos[model.jnt_qposadr[model.joint(name).id]] = angle
    mujoco.mj_kinematics(model, data)
    spec = mujoco.MjSpec.from_string(mjcf)
    for name in manifest.gripper.joints:
        joint = spec.joint(name)
        body = model.body(model.jnt_bodyid[model.joint(name).id])
        inverse, position, quaternion = np.empty(4), np.empty(3), np.empty(4)
        parent = int(model.body_parentid[body.id])
        mujoco.mju_negQuat(inverse, data.xquat[parent])
        mujoco.mju_rotVecQuat(position, data.xpos[body.id] - data.xpos[parent], inverse)
        mujoco.mju_mulQuat(quaternion, inverse, data.xquat[body.id])
        spec.body(body.name).pos, spec.body(body.name).quat = position, quaternion
        spec.delete(joint)
    return spec.compile()
