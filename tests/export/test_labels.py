"""What a run says of a policy that is exported: where it came from, how often it succeeds, where it holds."""

import hashlib
import json

import pytest

from toolkit.bundle.manifest import Held
from toolkit.errors import ToolkitError
from toolkit.export.labels import holds_of
from toolkit.export.packing import _held


def test_ranges_go_into_a_bundle_only_from_a_test_of_its_own_policy(tmp_path):
    policy = tmp_path / "run.policy.safetensors"
    policy.write_bytes(b"a policy")
    result = {
        "policy": hashlib.sha256(b"a policy").hexdigest(), "target": "jaco", "task": "pick", "episodes": 20,
        "ranges": {"delay": {"low": 0.0, "high": 2.0, "unit": "steps", "nominal": 0.0, "meaning": "late"}},
        "alone": [{"conditions": {}}, *({"conditions": {"delay": float(n)}} for n in (1, 2, 3))],
    }
    (tmp_path / "result.json").write_text(json.dumps(result))
    held = Held("delay", "steps", "late", 0.0, 0.0, 2.0, 0.0, 3.0, 20)
    assert holds_of(tmp_path, policy, "jaco", "pick") == (held,)
    table = "\n".join(_held((held,)))
    assert "## Where it holds" in table and "| late [steps] | 0 | 0 to 2 | 0 to 3 |" in table and "20 episodes" in table
    assert _held(()) == []
    with pytest.raises(ToolkitError, match="is of target jaco, but what is exported is iiwa; give its own stress test"):
        holds_of(tmp_path, policy, "iiwa", "pick")
    policy.write_bytes(b"another policy")
    with pytest.raises(ToolkitError, match="is of policy .*; give its own stress test"):
        holds_of(tmp_path, policy, "jaco", "pick")
    policy.write_bytes(b"a policy")
    (tmp_path / "result.json").write_text(json.dumps(result | {"ranges": {"delay": {"low": 1.0}}}))
    with pytest.raises(ToolkitError, match="is no result of a stress test"):
        holds_of(tmp_path, policy, "jaco", "pick")
    with pytest.raises(ToolkitError, match="give the folder of a finished stress --out"):
        holds_of(tmp_path / "nowhere", policy, "jaco", "pick")
