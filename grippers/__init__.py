"""Grippers and hands by name. Importing this package registers ADROIT with robosuite."""

from grippers.adroit import ADROIT
from grippers.gripper import Gripper
from grippers.jaco3 import JACO3
from grippers.panda_gripper import PANDA_GRIPPER
from grippers.rethink import RETHINK
from grippers.robotiq85 import ROBOTIQ85
from grippers.robotiq140 import ROBOTIQ140

GRIPPERS: dict[str, Gripper] = {g.name: g for g in (ADROIT, JACO3, ROBOTIQ85, ROBOTIQ140, PANDA_GRIPPER, RETHINK)}
