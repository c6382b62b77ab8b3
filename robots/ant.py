"""Gymnasium's Ant, and four-legged robots with other torsos, shoulders, hips and legs: the paper's second experiment.

The paper changes "lengths of torsos, thickness of legs, and widths of hips and shoulders" in five dimensions and publishes no number; these
are our own. The ant runs along +x, so that its shoulders are the legs at +x, whatever the names in the file.
"""

from dataclasses import dataclass
from pathlib import Path

import gymnasium
import mujoco

from robots.model_robot import Family, ModelRobot

SHOULDERS = ("front_left_leg", "right_back_leg")
"""Bodies on which the legs at +x hang, in ant.xml: left, right."""
HIPS = ("front_right_leg", "back_leg")
"""Bodies on which the legs at -x hang: left, right."""

TORSO = 0.50
"""How much longer a torso's half length becomes [m], and with it how far out its legs are mounted; the source's is a ball of 0.25 m."""
SHOULDER, HIP = 0.25, 0.25
"""How far out legs are mounted sideways [m]; the source's hang on the torso's centre."""
FRONT, HIND = -0.045, 0.06
"""Change of the legs' radius [m]; the source's is 0.08 m. Light in front and heavy behind, an ant has to run otherwise; the other way round
the source's policy bears it as it is."""


def _whole(body: str, quantity: str) -> str:
    """All belongs to the whole ant: what grows alike on every robot is one dimension, wherever it stands."""
    return "ant"


ANTS = Family("ant", element=_whole, root="torso")


def gymnasium_ant() -> mujoco.MjSpec:
    """Gymnasium's ant.xml on its floor, from the installed package, its torso's ball as an ellipsoid and every body and motor named.

    An ellipsoid of three equal radii is the same solid, weighs the same and meets the floor at one point as the ball does, and it can
    grow. A capsule of no length would meet the floor at two.
    """
    package = Path(gymnasium.__file__).parent
    spec = mujoco.MjSpec.from_file(str(package / "envs" / "mujoco" / "assets" / "ant.xml"))
    torso = spec.geom("torso_geom")
    torso.type, torso.size = mujoco.mjtGeom.mjGEOM_ELLIPSOID, [torso.size[0]] * 3
    for leg in range(1, 5):
        spec.joint(f"ankle_{leg}").parent.name = f"shank_{leg}"  # which the file leaves unnamed, as it does its motors
    for motor in spec.actuators:
        motor.name = motor.target
    return spec


@dataclass(frozen=True)
class Sizes:
    """How much of TORSO, SHOULDER, HIP, FRONT and HIND a robot has; 0: the source's."""

    torso: float = 0.0
    shoulder: float = 0.0
    hip: float = 0.0
    front: float = 0.0
    hind: float = 0.0

    def __call__(self, spec: mujoco.MjSpec) -> None:
        """Give a scene's source robot these sizes."""
        spec.geom("torso_geom").size[0] += self.torso * TORSO
        for legs, end, width, thicker in (
            (SHOULDERS, 1.0, self.shoulder * SHOULDER, self.front * FRONT),
            (HIPS, -1.0, self.hip * HIP, self.hind * HIND),
        ):
            for body, side in zip(legs, (1.0, -1.0), strict=True):
                leg = spec.body(body)
                leg.pos += [end * self.torso * TORSO, side * width, 0.0]
                for geom in leg.find_all("geom"):
                    geom.size[0] += thicker


_OURS = "a change of gymnasium's ant.xml; no such robot is sold"
ANT = ModelRobot("ant", ANTS, Sizes(), "gymnasium's ant.xml, as Ant-v5 and before it Ant-v2 play it", source_of_policy=True)

# The first is the coordinate-wise median of the source and the others, so that no meta robot makes the tree shorter: the paper's table of
# costs has six paths for six targets, and its path to the first is the independent one.
ANT_1 = ModelRobot("ant-1", ANTS, Sizes(torso=0.5, shoulder=0.0, hip=0.0, front=0.5, hind=0.5), _OURS)
ANT_2 = ModelRobot("ant-2", ANTS, Sizes(torso=1.0, shoulder=0.5, hip=0.0, front=0.5, hind=0.5), _OURS)
ANT_3 = ModelRobot("ant-3", ANTS, Sizes(torso=1.0, shoulder=1.0, hip=0.0, front=0.5, hind=0.5), _OURS)
ANT_4 = ModelRobot("ant-4", ANTS, Sizes(torso=0.5, shoulder=0.0, hip=1.0, front=1.0, hind=0.5), _OURS)
ANT_5 = ModelRobot("ant-5", ANTS, Sizes(torso=0.5, shoulder=0.5, hip=1.0, front=1.0, hind=0.5), _OURS)
ANT_6 = ModelRobot("ant-6", ANTS, Sizes(torso=0.5, shoulder=0.0, hip=1.0, front=1.0, hind=1.0), _OURS)
# In the place of the first one, it is no longer on the way to the others, and the shortest tree has a meta robot where the first one was.
ANT_1B = ModelRobot("ant-1b", ANTS, Sizes(torso=0.5, shoulder=0.0, hip=0.0, front=0.5, hind=0.0), _OURS)
