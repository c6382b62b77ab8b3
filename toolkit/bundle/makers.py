"""What the makers of arms allow: a bundle's limits are measured, and may be forged; these are neither.

A robot PC has no robosuite, and so not the cards in robots/, which say the same: a test holds both together. The sources stand there.
"""

from toolkit.bundle.manifest import Manifest
from toolkit.errors import ToolkitError

JOINT_SPEEDS: dict[str, tuple[float, ...]] = {
    "iiwa": (1.710, 1.710, 1.745, 2.268, 2.443, 3.141, 3.141),
    "jaco": (0.628, 0.628, 0.628, 0.628, 0.837, 0.837, 0.837),
    "kinova3": (1.396, 1.396, 1.396, 1.396, 1.2217, 1.2217, 1.2217),
    "panda": (2.175, 2.175, 2.175, 2.175, 2.610, 2.610, 2.610),
    "sawyer": (1.74, 1.328, 1.957, 1.957, 3.485, 3.485, 4.545),
    "ur5e": (3.141, 3.141, 3.141, 3.141, 3.141, 3.141),
}
"""The toolkit's name of an arm -> highest joint speeds [rad/s], base to flange, rounded down."""


def check_makers_limits(manifest: Manifest, where: str) -> None:
    """Refuse a manifest whose joints may move faster than their maker allows: hashes prove that a file is whole, not that it is true.

    Args:
        manifest: of an arm; one that is not in JOINT_SPEEDS is not judged.
        where: file, for messages.

    Raises:
        ToolkitError: a joint's speed limit lies above the maker's.
    """
    name = manifest.robot.name
    for joint, fastest in zip(manifest.joints, JOINT_SPEEDS.get(name, ()), strict=False):
        if joint.speed > fastest * (1 + 1e-9):
            raise ToolkitError(
                f"{where} lets joint {joint.name} move at {joint.speed:.3g} rad/s, but the maker of {name!r} allows {fastest:.3g} "
                f"(robots/{name}.py names the source); do not use this bundle, export it again"
            )
