"""robot.xml: the simulated arm's frames, and every shape of its gripper enclosed."""

import mujoco
import numpy as np
import pytest
from exported_targets import TARGETS

from toolkit.bundle.reading import load_bundle
from toolkit.deploy.kinematics import Kinematics


def encloses(model, geom, points):
    """Whether a box or capsule holds points (n, 3) given in its frame."""
    size, kind = model.geom_size[geom], model.geom_type[geom]
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return bool((np.abs(points) <= size + 1e-6).all())
    assert kind == mujoco.mjtGeom.mjGEOM_CAPSULE
    axis = np.column_stack([0 * points[:, :2], np.clip(points[:, 2], -size[1], size[1])])
    return bool((np.linalg.norm(points - axis, axis=1) <= size[0] + 1e-6).all())


def corners(model, geom):
    """Vertices (n, 3) of a mesh or box in its geom's frame."""
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = model.geom_dataid[geom]
        return model.mesh_vert[model.mesh_vertadr[mesh] : model.mesh_vertadr[mesh] + model.mesh_vertnum[mesh]]
    return np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T * model.geom_size[geom]


@pytest.mark.parametrize("name", TARGETS)
def test_the_mjcf_is_the_simulated_arm(exported, native, name):
    """Random arm and finger angles: same grasp frame, same lowest point of the gripper, every shape of it enclosed."""
    manifest, robot = exported(name)[1], native(name)
    bundle, model, data = load_bundle(exported(name)[0]), robot.model, mujoco.MjData(robot.model)
    kinematics = Kinematics.of(manifest, bundle.mjcf)
    arm = [model.joint("robot0_" + joint.name).qposadr[0] for joint in manifest.joints]
    fingers = [model.joint("gripper0_right_" + joint).qposadr[0] for joint in manifest.gripper.joints]
    hung = [g for g in range(model.ngeom) if model.geom(g).name.startswith("gripper0_right_") and model.geom_group[g] == 0]
    rng, site, bundle_model = np.random.default_rng(0), model.site("gripper0_right_grip_site").id, kinematics.model
    for _ in range(20):
        data.qpos[:] = robot.data.qpos
        data.qpos[arm] += rng.uniform(-0.5, 0.5, 7)
        data.qpos[fingers] += rng.uniform(-0.2, 0.2, len(fingers))
        mujoco.mj_kinematics(model, data)
        kinematics.place(data.qpos[arm], data.qpos[fingers])
        assert np.abs(kinematics.position - data.site_xpos[site]).max() < 1e-12
        assert np.abs(kinematics.rotation - data.site_xmat[site].reshape(3, 3)).max() < 1e-12
        points = [data.geom_xpos[g] + corners(model, g) @ data.geom_xmat[g].reshape(3, 3).T for g in hung]
        lowest = min(float(p[:, 2].min()) for p in points)
        assert abs(kinematics.lowest() - lowest) < 1e-6, f"{name}: the lowest point is off by {kinematics.lowest() - lowest:.1e} m"
        shapes = [bundle_model.geom(model.geom(g).name.removeprefix("gripper0_right_")).id for g in hung]
        for shape, cloud in zip(shapes, points, strict=True):
            local = (cloud - kinematics.data.geom_xpos[shape]) @ kinematics.data.geom_xmat[shape].reshape(3, 3)
            assert encloses(bundle_model, shape, local), f"{name}: {bundle_model.geom(shape).name} does not enclose its mesh"
