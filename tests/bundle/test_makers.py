"""No bundle moves an arm faster than its maker allows, whatever its hashes say."""

import json
import zipfile

import pytest

from robots import ROBOTS
from toolkit.bundle.makers import JOINT_SPEEDS
from toolkit.bundle.reading import FILES, find_bundle, load_bundle
from toolkit.errors import ToolkitError


def test_the_table_is_the_cards():
    assert JOINT_SPEEDS == {name: robot.joint_speeds for name, robot in ROBOTS.items() if robot.joint_speeds is not None}


@pytest.mark.parametrize("name", ["jaco", "kinova3", "iiwa"])
def test_a_forged_speed_is_refused_with_its_joint(tmp_path, name):
    """Three rad/s, or just above what the maker allows; the shipped ones load."""
    manifest = load_bundle(name).manifest
    with zipfile.ZipFile(find_bundle(name)) as archive:
        for entry in archive.namelist():
            if entry.rsplit("/", 1)[-1] in FILES:
                (tmp_path / entry.rsplit("/", 1)[-1]).write_bytes(archive.read(entry))
    content = json.loads((tmp_path / "manifest.json").read_text())
    for joint, speed in ((0, 3.0), (1, 1.001 * JOINT_SPEEDS[name][1])):
        forged = json.loads(json.dumps(content))
        forged["joints"][joint]["speed"] = speed
        (tmp_path / "manifest.json").write_text(json.dumps(forged))
        with pytest.raises(ToolkitError, match=f"lets joint {manifest.joints[joint].name} move at .* maker of '{name}' allows"):
            load_bundle(tmp_path)
    (tmp_path / "manifest.json").write_text(json.dumps(content))
    assert load_bundle(tmp_path).manifest == manifest
