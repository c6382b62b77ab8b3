"""export: a policy leaves the toolkit."""

from pathlib import Path
from typing import Annotated

import tyro

from toolkit.cli.names import find_robot, find_task, trained_policies
from toolkit.cli.terminal import emit


def export(run: Annotated[Path, tyro.conf.Positional], target: str, out: Path, json: bool = False) -> None:
    """Write a target's policy as an ONNX bundle: named observations in, robosuite's own action out.

    Args:
        run: a run folder.
        target: which target.
        out: folder of the bundle; made if needed.
        json: print the manifest.
    """
    content, policies = trained_policies(run, target)
    from toolkit.bundle import write_bundle

    manifest = write_bundle(policies[target], find_robot(target), find_task(content["task"]), content, out)
    emit(manifest, json, f"{out}: policy.onnx, manifest.json; ONNX against NumPy {manifest['onnx_max_abs_error']:.1e}")
