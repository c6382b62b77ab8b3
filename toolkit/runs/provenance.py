"""What a run ran on: versions of what determines its numbers, and the commit of the checkout."""

import hashlib
import platform
import subprocess
from importlib import metadata
from pathlib import Path
from typing import Any

from toolkit import __version__

RECORDED_PACKAGES = ("mujoco", "robosuite", "torch", "pin", "mink", "rerun-sdk", "numpy", "numba", "onnx", "onnxruntime")


def recorded_versions() -> dict[str, str | None]:
    """Versions of what determines a run's numbers; None where a package is absent. No host name, no path."""
    versions: dict[str, str | None] = {"meta-evolve": __version__, "python": platform.python_version()}
    for package in RECORDED_PACKAGES:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            versions[package] = None
    return versions | {"platform": f"{platform.system()} {platform.machine()}"}


def code_digest() -> str:
    """sha256 of all Python files that determine a run: the toolkit and the cards; no matter where they lie, or in what order."""
    root, found = Path(__file__).parents[2], hashlib.sha256()
    for file in sorted(path for package in ("toolkit", "robots", "grippers", "tasks") for path in (root / package).rglob("*.py")):
        content = file.read_bytes()
        found.update(f"{file.relative_to(root).as_posix()} {len(content)}\n".encode() + content)
    return found.hexdigest()


def git_state() -> dict[str, Any] | None:
    """Commit of the checkout that this file belongs to; None when installed or when git is not there."""

    def git(*arguments: str) -> str:
        answer = subprocess.run(
            ["git", "-C", str(Path(__file__).parent), *arguments], capture_output=True, text=True, check=True, timeout=20
        )
        return answer.stdout.strip()

    try:
        git("ls-files", "--error-unmatch", Path(__file__).name)  # fails in another project's checkout around a venv
        return {"commit": git("rev-parse", "HEAD"), "dirty": bool(git("status", "--porcelain"))}
    except (OSError, subprocess.SubprocessError):
        return None
