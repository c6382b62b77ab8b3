"""meta-evolve with one target broken on purpose: a Kinova Gen3 whose fingers have no friction.

    python docs/slippery.py transfer --targets greased --run logs/slippery
    python docs/slippery.py view logs/slippery

docs/inspect.md finds the broken phase from the views alone. Of two bodies that touch, the larger friction counts, so the brick
has none either: every other hand holds it by its own.
"""

from dataclasses import replace

from toolkit.quiet import silence_robosuite

silence_robosuite()
from robosuite.models.grippers import register_gripper  # noqa: E402
from robosuite.models.grippers.robotiq_85_gripper import Robotiq85Gripper  # noqa: E402

from robots import ROBOTS  # noqa: E402
from tasks import TASKS  # noqa: E402
from toolkit.cli import main  # noqa: E402


@register_gripper
class GreasedGripper(Robotiq85Gripper):
    """robosuite's Robotiq 2F-85 without friction."""

    def __init__(self, idn: int | str = 0) -> None:
        super().__init__(idn)
        for geom in self.worldbody.iter("geom"):
            geom.set("friction", "0 0 0")


# At import, so that the worker processes of an evaluation know them too.
sound, task = ROBOTS["kinova3"], TASKS["061_foam_brick"]
gripper = replace(sound.gripper, name="greased85", robosuite_type=GreasedGripper.__name__)
ROBOTS["greased"] = replace(sound, name="greased", gripper=gripper)
TASKS[task.name] = replace(task, object=replace(task.object, friction=(0.0, 0.0, 0.0)))

if __name__ == "__main__":
    main()
