"""docs/gpu.md names every array that F writes, so that what is said of each holds for all."""

import re
from pathlib import Path

import numpy as np
import pytest

from tasks import MODEL_TASKS
from toolkit.cli.names import family_of
from toolkit.morphology.lab import Lab

PAGE = (Path(__file__).parents[2] / "docs" / "gpu.md").read_text(encoding="utf-8")


def written(lab):
    """Arrays of the model that differ between the robots of a lab and one half way between them."""
    model, data = lab.merged.new()
    betas, seen = [lab.space.beta(name) for name in lab.space.names], []
    for alpha in [*betas, np.mean(betas, axis=0)]:
        lab.merged.become(alpha, model, data)
        arrays = {name: getattr(model, name) for name in dir(model) if not name.startswith("_")}
        seen.append({name: array.copy() for name, array in arrays.items() if isinstance(array, np.ndarray)})
    return {name for one in seen[1:] for name in one if not np.array_equal(one[name], seen[0][name])}


@pytest.fixture(params=["arms with grippers", "hands", "ants"])
def robots(request, pair):
    """(row of the page, lab)."""
    if request.param == "arms with grippers":
        return request.param, pair
    task = MODEL_TASKS["door" if request.param == "hands" else "ant-maze"]
    robots = family_of(task)
    return request.param, Lab(robots[0], robots[1:], task)


def test_the_page_names_what_f_writes(robots):
    name, lab = robots
    (row,) = re.findall(rf"^\| {name} .*$", PAGE, re.MULTILINE)
    arms = next(line for line in PAGE.splitlines() if line.startswith("| arms with grippers ("))
    follow = set(re.findall(r"\w+", re.search(r"what follows from these: ([\w, ]+)", arms).group(1)))
    named = set(re.findall(r"\b[a-z]+_\w+\b", row)) | follow | {"cam_poscom0"}
    missing = written(lab) - named
    assert not missing, f"{name}: F writes {', '.join(sorted(missing))}, of which docs/gpu.md does not tell"
    assert len(written(lab)) >= 14, "F changed next to nothing"
