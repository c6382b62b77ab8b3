"""Experts by name: those that are shipped, and how one is kept and loaded."""

import json
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

from tasks.pick import PickTask
from tasks.task import Task
from toolkit.errors import ToolkitError
from toolkit.io.quoting import told
from toolkit.learning.policy import GaussianPolicy, ValueFunction

SHIPPED = Path(__file__).parent / "shipped"
"""Folder of the experts that come with the package."""


def narrow_task(task: Task) -> Task:
    """A pick with the small start noise, +-1 cm and no yaw, for which an expert of the wide one serves as well; any other task as it is."""
    if not isinstance(task, PickTask):
        return task
    return replace(task, noise_xy=min(task.noise_xy, 0.01), noise_yaw=0.0)


POLICY_FILE = ".policy.safetensors"
"""Ends the name of a policy's file, in SHIPPED and in a run folder."""
RECORDED = "-recordings"
"""Ends the name of an expert that learned from recordings of hands."""


def expert_files(source: str, task: str) -> tuple[Path, Path]:
    """Files of the shipped expert's policy and value function: the task's own, or those of its wide variant.

    One that was scripted goes before one that learned from recordings.
    """
    names = [f"{source}-{task}{wide}{kind}" for kind in ("", RECORDED) for wide in ("", "-wide")]
    name = next((name for name in names if (SHIPPED / f"{name}{POLICY_FILE}").is_file()), names[0])
    return SHIPPED / f"{name}{POLICY_FILE}", SHIPPED / f"{name}.value.safetensors"


def shipped_experts() -> list[str]:
    """Names of the experts that come with the package, sorted."""
    return sorted(file.name.removesuffix(POLICY_FILE) for file in SHIPPED.glob(f"*{POLICY_FILE}"))


def shipped_pair(name: str, robots: Iterable[str] = ()) -> tuple[str, str]:
    """Source and task of a shipped expert's name; ``robots`` are those whose names may hold a hyphen."""
    source = next((robot for robot in robots if name.startswith(f"{robot}-")), name.partition("-")[0])
    return source, name.removesuffix(RECORDED).removeprefix(f"{source}-")


def save_expert(policy: GaussianPolicy, value: ValueFunction, folder: Path, name: str, card: dict[str, Any]) -> None:
    """Write policy, value function and a card that says how they came about."""
    folder.mkdir(parents=True, exist_ok=True)
    policy.save(folder / f"{name}{POLICY_FILE}")
    value.save(folder / f"{name}.value.safetensors")
    (folder / f"{name}.json").write_text(json.dumps(card, indent=1) + "\n")


def taught_by_hands(source: str, task: str) -> str | None:
    """Name of the shipped expert that learned a task from recordings of hands, None where there is none."""
    names = [f"{source}-{task}{wide}{RECORDED}" for wide in ("-wide", "")]
    return next((name for name in names if name in shipped_experts()), None)


def load_expert(source: str, task: Task, name: str | None = None) -> tuple[GaussianPolicy, ValueFunction]:
    """The expert of a source robot and a task, or of the task's nearest kin that has one.

    Args:
        source, task: for which one is shipped.
        name: another one: of a shipped expert, or of the files of one's own without their endings.

    Raises:
        ToolkitError: there is none; the sentence gives the command that trains one.
    """
    folder = SHIPPED if name is None or name in shipped_experts() else Path()
    served = next((known for known in (task.name, *task.kin) if expert_files(source, known)[0].is_file()), task.name)
    policy_file, value_file = expert_files(source, served) if name is None else (
        folder / f"{name}{POLICY_FILE}", folder / f"{name}.value.safetensors")
    if name is not None and not policy_file.is_file():
        raise ToolkitError(
            f"there is no expert {name!r}: neither {policy_file} nor one of those that are shipped, {', '.join(shipped_experts())}"
        )
    if not policy_file.is_file():
        raise ToolkitError(
            f"no expert is shipped for source {source!r} and task {task.name!r}; there are: {', '.join(shipped_experts()) or 'none'}; "
            f"train one with: {told('expert', '--source', source, '--task', task.name)}"
        )
    policy = GaussianPolicy.load(policy_file, task.observation.names, task.action.names)
    return policy, ValueFunction.load(value_file, task.observation.names)
