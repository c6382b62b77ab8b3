"""meta-evolve with one target broken on purpose: the fingers of the robot named below have no friction.

    python docs/slippery.py transfer --targets kinova3 jaco --run logs/slippery
    python docs/slippery.py view logs/slippery --rebuild

docs/inspect.md finds the broken phase from the views alone.
"""

from typing import Any

from toolkit.cli import main
from toolkit.quiet import silence_robosuite

BROKEN = "jaco"


def grease() -> None:
    """Take the friction of one gripper away, on the unmodified robot and on the merged one.

    In a contact the larger friction of the two counts, so the fingers need priority over the object too.
    """
    import toolkit.evaluation
    import toolkit.morphology.matching
    import toolkit.simulation.plant
    from toolkit.morphology import posture
    from toolkit.morphology.build import MergedRobot

    compile_merged, make_native = MergedRobot.compile, posture.native_env

    def slippery_env(robot: Any, task: Any) -> Any:
        env = make_native(robot, task)
        if robot.name == BROKEN:
            model = env.sim.model._model
            fingers = [geom for geom in range(model.ngeom) if model.geom(geom).name.startswith("gripper0_")]
            model.geom_friction[fingers], model.geom_priority[fingers] = 0.0, 1
        return env

    def compile_with_priority(merged: MergedRobot, alpha: Any) -> Any:
        model = compile_merged(merged, alpha)
        model.geom_priority[[model.geom(shape.name).id for shape in merged.space.shape_slots]] = 1
        return model

    for module in (toolkit.morphology.matching, toolkit.simulation.plant, toolkit.evaluation):
        module.native_env = slippery_env
    MergedRobot.compile = compile_with_priority


silence_robosuite()
grease()  # at import, so that the processes of an evaluation are broken alike

if __name__ == "__main__":
    main()
