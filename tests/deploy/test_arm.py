"""An arm that does not fit a bundle is refused by name."""

import pytest

from toolkit.deploy.arm import ArmInfo, check_fit
from toolkit.errors import ToolkitError


def facts(manifest):
    return {"robot": manifest.robot.name, "joints": tuple(j.name for j in manifest.joints), "fingers": manifest.gripper.joints,
            "forms": ("osc", "joint"), "rate_hz": 500.0}


@pytest.mark.parametrize("change, sentence", [
    ({"robot": "iiwa"}, "the driver moves robot 'iiwa', but the bundle is for 'kinova3'"),
    ({"joints": ("A",) * 7}, "joint 'A'"),
    ({"joints": ("Actuator1", "Actuator2", "Actuator3", "Actuator4", "Actuator5", "Actuator6")}, "the driver lacks joint 'Actuator7'"),
    ({"fingers": ("thumb",)}, "finger joint"),
    ({"angle_unit": "deg"}, "angles in 'deg', the bundle takes 'rad'"),
    ({"length_unit": "mm"}, "lengths in 'mm'"),
    ({"frame": "camera"}, "frame in 'camera'"),
    ({"forms": ("joint",)}, "takes no 'osc' commands"),
    ({"rate_hz": 10.0}, "slower than the policy"),
    ({"model_sha256": "0" * 64}, "not the model that the bundle was made on"),
])
def test_an_arm_that_does_not_fit_is_refused_by_name(change, sentence):
    from toolkit.bundle.reading import load_bundle

    manifest = load_bundle("kinova3").manifest
    check_fit(manifest, ArmInfo(**facts(manifest)), "osc")
    check_fit(manifest, ArmInfo(**facts(manifest) | {"joints": tuple(reversed(facts(manifest)["joints"]))}), "osc")  # by name
    with pytest.raises(ToolkitError, match=sentence):
        check_fit(manifest, ArmInfo(**facts(manifest) | change), "osc")
