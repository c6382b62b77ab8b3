"""A dry run: its loop never touches what sends, and a gripper that is not read stands at its preshape."""

import time

import numpy as np

from toolkit.bundle.reading import load_bundle
from toolkit.deploy.arm import ArmInfo, Command, State
from toolkit.deploy.dry import dry_run, nominal_opening, nominal_scene
from toolkit.deploy.runtime import Runtime


def test_the_loop_never_touches_what_sends():
    bundle = load_bundle("iiwa")
    start, scene = np.array(bundle.manifest.start.arm_rad), nominal_scene(bundle.manifest)

    class Listener:
        def listen(self):
            return ArmInfo("iiwa", tuple(joint.name for joint in bundle.manifest.joints), (), ("osc",), 20.0)

        def read(self):
            return State(time.monotonic(), start, *scene()[:3], opening=nominal_opening(bundle.manifest))

        def __getattr__(self, name):
            raise AssertionError(f"{name} was asked for")

    slept, arm = [], Listener()
    seen = list(dry_run(Runtime(bundle, arm.listen(), "osc"), arm, 5, slept.append))
    assert len(seen) == len(slept) == 5 and all(isinstance(tick.command, Command) and tick.fault is None for tick in seen)
    np.testing.assert_array_equal(seen[0].command.target, seen[4].command.target)
    assert seen[0].action.shape == (7,) and min(slept) >= 0 and 0 < max(slept) <= 0.25, "a policy period each"


def test_the_jacos_nominal_opening_is_its_preshape():
    manifest = load_bundle("jaco").manifest
    assert manifest.gripper.preshape > -1 and 0.2 < nominal_opening(manifest) < 1.0
