"""meta-evolve: transfer a dexterous hand's policy to commercial arms by continuous robot evolution.

Data flows one way: robots and grippers -> trees -> matching -> space -> F(alpha) -> evolution tree -> rollouts ->
natural policy gradient -> transfer -> run folder -> evaluation, recording, export. See docs/architecture.md.

Conventions: SI units, radians, quaternions w first, transforms named by both frames, alpha and theta as words.

Importing any part of it makes sure that ``robots``, ``grippers`` and ``tasks`` are the packages that stand beside it, whatever files of
these names, common as they are, stand in a folder that Python searches first.
"""

import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path

__version__ = "0.1.0"
BESIDE = ("grippers", "robots", "tasks")


class _Beside:
    """Finds the packages of ``BESIDE`` in the folder that holds this one."""

    @staticmethod
    def find_spec(name: str, path: Sequence[str] | None = None, target: object = None) -> ModuleSpec | None:
        """As importlib asks every entry of ``sys.meta_path``."""
        return PathFinder.find_spec(name, [str(Path(__file__).parents[1])]) if name in BESIDE else None


def stranger(name: str) -> str | None:
    """Where a package of this name came from that is imported already and does not stand beside this one; None if there is none."""
    module = sys.modules.get(name)
    ours = Path(__file__).parents[1] / name
    if module is None or any(Path(place).resolve() == ours.resolve() for place in getattr(module, "__path__", ())):
        return None
    return getattr(module, "__file__", None) or f"a folder {name}"


sys.meta_path.insert(0, _Beside)
for _name in BESIDE:
    if _file := stranger(_name):
        raise ImportError(f"{_file} was imported as {_name}, the name of a package of meta-evolve; rename that file")
