"""robots, match: the systems known, and what merging them keeps of each."""

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from toolkit.cli.names import TASK, all_robots, broken_cards, family_of, find_arm, find_task, make_lab, merged_arms
from toolkit.cli.terminal import Progress, emit, room_for, short, table
from toolkit.errors import ToolkitError

if TYPE_CHECKING:
    from robots.model_robot import ModelRobot
    from robots.robot import Robot
    from tasks.task import ModelTask
    from toolkit.morphology.lab import Lab
    from toolkit.morphology.matching import Matching


def robots(check: str | None = None, json: bool = False) -> None:
    """List the systems that can be source or target, or check one that is being added.

    Args:
        check: name of a system: say all that is wrong with its card and models, then try to start it.
        json: print one JSON object instead of a table.
    """
    known = all_robots()
    from robots import MODEL_ROBOTS
    from tasks import MODEL_TASKS, TASKS

    if check is not None:
        if check in MODEL_ROBOTS:
            _check_change(MODEL_ROBOTS[check], json)
        else:
            _check(find_arm(check), json)
        return
    rows = [
        {"name": r.name, "role": "source" if r.source_of_policy else "target", "arm": r.arm,
         "gripper": r.gripper.robosuite_type, "rate": r.gripper.rate, "preshape": r.gripper.preshape}
        for r in known.values()
    ]
    changes = [
        {"name": r.name, "role": "source" if r.source_of_policy else "target", "family": r.family.name,
         "tasks": [task.name for task in MODEL_TASKS.values() if task.family == r.family.name]}
        for r in MODEL_ROBOTS.values()
    ]
    if json:
        emit({"robots": rows, "model_robots": changes, "tasks": [*TASKS, *MODEL_TASKS], "broken": broken_cards()}, True, "")
    else:
        table("Systems", list(rows[0]), [["" if value is None else value for value in row.values()] for row in rows])
        table("Changes of one model", ["name", "role", "family", "tasks"],
              [[r["name"], r["role"], r["family"], ", ".join(r["tasks"])] for r in changes])
        print(f"Tasks: {', '.join([*TASKS, *MODEL_TASKS])}")
    _say_broken()


def _say_broken() -> None:
    """Refuse, once everything else is said, if a card does not load."""
    broken = broken_cards()
    if broken:
        more = f" (and {len(broken) - 1} more: {'; '.join(broken[1:])})" if len(broken) > 1 else ""
        raise ToolkitError(broken[0] + more)


def _check(robot: "Robot", json: bool) -> None:
    from toolkit.morphology.posture import start_of
    from toolkit.morphology.validation import findings

    found = findings(robot)
    if found:
        emit({"name": robot.name, "findings": found}, json, "\n".join(found))
        raise ToolkitError(f"robot {robot.name}: {len(found)} thing{'s' if len(found) > 1 else ''} to mend")
    start = start_of(robot)
    arm = ", ".join(f"{angle:.3f}" for angle in start.arm)
    text = f"{robot.name}: nothing is wrong; it starts with its arm at {arm} rad. Next: meta-evolve match --targets {robot.name}"
    emit({"name": robot.name, "findings": [], "start_arm_rad": start.arm.tolist()}, json, text)


def _check_change(robot: "ModelRobot", json: bool) -> None:
    """A change of a model: whether it compiles in every task of its family, and another robot of that family can become it."""
    from tasks import MODEL_TASKS
    from toolkit.morphology.family import FamilySpace

    found: list[str] = []
    dimensions: dict[str, int] = {}
    for task in MODEL_TASKS.values():
        if task.family == robot.family.name:
            others = [other for other in family_of(task) if other.name != robot.name][:1]
            try:
                dimensions[task.name] = FamilySpace([*others, robot], task).size
            except ToolkitError as error:
                found.append(str(error))
    if not dimensions and not found:
        found.append(f"no task is for robots of the family {robot.family.name}")
    if found:
        emit({"name": robot.name, "findings": found}, json, "\n".join(found))
        raise ToolkitError(f"robot {robot.name}: {len(found)} thing{'s' if len(found) > 1 else ''} to mend")
    away = ", ".join(f"{size} in {task}" for task, size in dimensions.items())
    text = f"{robot.name}: nothing is wrong; from {others[0].name} to it there are as many dimensions: {away}"
    emit({"name": robot.name, "findings": [], "dimensions": dimensions}, json, text)


def match(
    source: str = "adroit",
    targets: tuple[str, ...] = (),
    task: str = TASK,
    theta: bool = False,
    plot: Path | None = None,
    episodes: int = 0,
    json: bool = False,
) -> None:
    """Merge robots into one kinematic tree and measure what the merge keeps of each.

    Args:
        source: the robot that the expert was trained on.
        targets: where the policy should go; default: every system that is no source, of a family's task every other robot of it.
        task: in whose scene they stand; of robots that are changes of one model, as of ant-maze, the dimensions are listed.
        theta: list every parameter of the evolution space, and what the quantities mean.
        plot: draw the merged tree into this file (PNG, PDF or SVG).
        episodes: let the source's expert play so many on the merged source and on the source robot itself, from the same seeds.
        json: print one JSON object.
    """
    if episodes < 0:
        raise ToolkitError(f"episodes is {episodes}; give 0 to play none")
    room_for(plot)
    what = find_task(task)
    from tasks.task import ModelTask

    if isinstance(what, ModelTask):
        others = tuple(robot.name for robot in family_of(what) if robot.name != source)
        _match_family(source, targets or others, what, theta, plot, episodes, json)
        return
    every = not targets
    targets = targets or tuple(name for name, robot in all_robots().items() if not robot.source_of_policy and name != source)
    with Progress("match", quiet=json) as progress:
        lab = make_lab(source, targets, task)
        from toolkit.benchmarks.parity import become_milliseconds, parity
        from toolkit.inspection.merged_tree import plot_merged_tree
        from toolkit.morphology.quantities import QUANTITIES

        merged = merged_arms(lab.merged)
        figures: list[dict[str, Any]] = []
        for name in [robot.name for robot in (lab.source, *lab.targets)]:
            progress.show("match", f"measuring {name}", len(figures), len(targets) + 1)
            figures.append(parity(merged, find_arm(name)))
        milliseconds = become_milliseconds(merged)
        if episodes:
            progress.show("match", f"{episodes} episodes on the merged {source} and on robosuite's", now=True)
        survival = _survival(lab, episodes) if episodes else []
    content = {"D": lab.space.size, "source": source, "parameters": len(lab.space.parameters),
               "become_ms": milliseconds, "robots": figures, "dropped_meshes": merged.space.matching.dropped_meshes,
               "expert": survival,
               "pairs": [asdict(pair) | {"overridden": pair.overridden} for pair in merged.space.matching.pairs]}
    if theta:
        content |= {"theta": lab.space.describe(), "quantities": QUANTITIES}
    if json:
        emit(content, True, "")
    else:
        _show_match(merged.space.matching, content)
    if plot is not None:
        plot_merged_tree(merged.space.matching, plot)
    if every:
        _say_broken()


def _match_family(
    source: str, targets: tuple[str, ...], task: "ModelTask", theta: bool, plot: Path | None, episodes: int, json: bool
) -> None:
    """``match`` of robots that are changes of one model: they are matched by names, so that all that there is to say is their space."""
    if plot is not None:
        raise ToolkitError(f"robots of the family {task.family} have one kinematic tree, so that none is merged; leave out --plot")
    from toolkit.benchmarks.parity import become_milliseconds

    with Progress("match", quiet=json) as progress:
        lab = make_lab(source, targets, task.name)
        milliseconds = become_milliseconds(lab.merged)
        if episodes:
            progress.show("match", f"{episodes} episodes on the merged {source} and on the unmodified one", now=True)
        survival = _survival(lab, episodes) if episodes else []
    space = lab.space
    moved: dict[int, list[str]] = {}
    for parameter in space.parameters:
        moved.setdefault(parameter.dimension, []).append(parameter.name)
    content = {"D": space.size, "source": source, "task": task.name, "parameters": len(space.parameters), "become_ms": milliseconds,
               "robots": [{"name": name, "alpha": space.beta(name).tolist()} for name in space.names], "expert": survival}
    if theta:
        content["theta"] = space.describe()
    if json:
        emit(content, True, "")
        return
    _say_space(content)
    table("Dimensions", ["", "first of its parameters", "parameters", *space.names],
          [[k, names[0], len(names), *(f"{beta[k]:.3g}" for beta in space.betas)] for k, names in sorted(moved.items())])
    _say_survival(content)
    if theta:
        _show_theta(content)


def _say_space(found: dict) -> None:
    print(f"Evolution space: D = {found['D']} dimensions move {found['parameters']} parameters.")
    print(f"Any of its robots is made of any other in {found['become_ms']:.2f} ms (median).")


def _say_survival(found: dict) -> None:
    for played in found["expert"]:
        where, (low, high) = "F(beta)" if played["env"] == "merged" else "the unmodified robot", played["ci95"]
        print(f"{found['source']}'s expert on {where}: {played['successes']} of {played['episodes']} episodes succeed "
              f"(95 % interval {low:.3f} to {high:.3f}).")


def _show_theta(found: dict) -> None:
    names = [robot["name"] for robot in found["robots"]]
    table("theta", ["parameter", "unit", "dimension", *names],
          [[p["name"], p["unit"], p["dimension"], *(short(v) for v in p["values"].values())] for p in found["theta"]])


def _show_match(matching: "Matching", found: dict) -> None:
    """What ``match`` found, for people."""
    figures, names = found["robots"], matching.names
    _say_space(found)
    brief = lambda value: f"{value:.0e}" if 0.0 < value < 1e-3 else f"{value:.2g}"  # noqa: E731
    rows = [[figure.replace("_", " "), *(brief(f[figure]) for f in figures)] for figure in figures[0] if figure != "name"]
    table("Merged robot against the robosuite robot", ["figure", *(f["name"] for f in figures)], rows)
    dropped = [f"{name} {count}" for name, count in found["dropped_meshes"].items() if count]
    if dropped:
        print(f"Collision meshes that the merged grippers go without, touching by their primitives: {', '.join(dropped)}.")
    _say_survival(found)
    slots = matching.slots
    rows = [
        [slot.name, slots[slot.parent].name if slot.parent >= 0 else "world", *("yes" if s.present(i) else "-" for s in matching.systems)]
        for i, slot in enumerate(slots)
    ]
    origin = lambda pair: "the card overrules" if pair.overridden else "geometry and card agree" if pair.by_card else "geometry"  # noqa: E731
    table("Pairs: which joint is which of the source's, and who says so", ["robot", "its joint", "plays", "geometry proposes", "by"],
          [[p.robot, p.joint, p.slot, p.proposed or "-", origin(p)] for p in matching.pairs])
    table("Matched joints", ["joint", "parent", *names], rows)
    if "theta" in found:
        _show_theta(found)
        table("What the quantities are", ["quantity", "meaning"], list(found["quantities"].items()))


def _survival(lab: "Lab", episodes: int) -> list[dict]:
    """The source's expert on F(beta) of the source and on the source robot itself under the compiled step, same seeds."""
    from toolkit.evaluation.success import evaluate_compiled, evaluate_merged
    from toolkit.expert.shelf import load_expert
    from toolkit.simulation.rollout import RolloutEngine

    policy, _ = load_expert(lab.source.name, lab.task)
    engine = RolloutEngine(lab.merged)
    played = [
        evaluate_merged(policy, engine, lab.source.name, episodes),
        evaluate_compiled(policy, lab.source, lab.task, episodes),
    ]
    engine.close()
    return [evaluation.to_json() for evaluation in played]
