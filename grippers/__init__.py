"""Grippers and hands by name, one file each. Importing this package registers ADROIT with robosuite."""

from grippers.cards import discover
from grippers.gripper import Gripper

GRIPPERS: dict[str, Gripper] = discover(__name__, Gripper)
