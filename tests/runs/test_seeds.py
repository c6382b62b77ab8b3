"""Seeds: no two purposes share any."""

import re
from pathlib import Path

import toolkit
from toolkit.runs.seeds import EVALUATION_SEEDS

BLOCK = 10**6


def test_no_two_purposes_share_seeds():
    """Every constant of the package that names seeds is the first of its own million, and evaluation's are above them all."""
    named = re.compile(r"^(\w+_SEEDS) = (.+)$", re.MULTILINE)
    found = {
        (file.stem, name): eval(value, {"__builtins__": {}})
        for file in sorted(Path(toolkit.__file__).parent.rglob("*.py"))
        for name, value in named.findall(file.read_text())
    }
    assert {file for file, _ in found} == {"seeds"}, "seeds are named in one file"
    assert found.pop(("seeds", "EVALUATION_SEEDS")) == EVALUATION_SEEDS
    assert found.pop(("seeds", "TRAINING_SEEDS")) == BLOCK, "training's seeds are the first million"
    assert {("seeds", "EXPERT_SEEDS"), ("seeds", "VISIT_SEEDS"), ("seeds", "DEMONSTRATION_SEEDS")} <= found.keys()
    blocks = {name: divmod(first, BLOCK) for name, first in found.items()}
    assert len({block for block, _ in blocks.values()}) == len(blocks) and all(rest == 0 for _, rest in blocks.values()), blocks
    assert all(0 < block and (block + 1) * BLOCK <= EVALUATION_SEEDS for block, _ in blocks.values()), blocks
