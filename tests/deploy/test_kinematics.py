"""Rotations and their vectors, and a robot file that is none; the kinematics of real bundles, tests/export/test_packing.py shows."""

import numpy as np
import pytest

from toolkit.deploy.kinematics import Kinematics, rotation_of, vector_of
from toolkit.errors import ToolkitError


def test_rotation_vectors_and_matrices_agree():
    rng = np.random.default_rng(0)
    for vector in rng.uniform(-1.5, 1.5, (50, 3)):
        np.testing.assert_allclose(vector_of(rotation_of(vector)), vector, atol=1e-12)


@pytest.mark.parametrize("text", ["", "<mujoco><include file='/etc/passwd'/></mujoco>", "<mujoco><worldbody/></mujoco>", "not xml"])
def test_a_robot_file_that_is_none_is_refused(bundle, text):
    with pytest.raises(ToolkitError, match="export the bundle again"):
        Kinematics.of(bundle.manifest, text)
