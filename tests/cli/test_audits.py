"""audit: every edge of the tree with the robots on it, as JSON and as a picture."""

import pytest
from command_line import answer, refusal

pytestmark = pytest.mark.usefixtures("at_home")


@pytest.mark.slow
def test_the_audit_of_the_robots(capsys, lab, tmp_path):
    """Two robots per edge are its ends, and the refined ones; tests/capability holds what they must be able to do."""
    names = lab.space.matching.names
    found = answer(capsys, "audit", "--targets", *names[1:], "--kind", "independent", "--robots", "2", "--episodes", "0", "--tries", "4",
                   "--no-causes", "--plot", tmp_path / "audit.svg")
    assert [(edge["from"], edge["to"]) for edge in found["edges"]] == [(names[0], name) for name in names[1:]]
    for edge in found["edges"]:
        shares = [robot["share"] for robot in edge["robots"]]
        assert shares == sorted(shares) and (shares[0], shares[-1]) == (0.0, 1.0) and len(shares) > 3
        assert {"share", "grip_n", "balance", "height_mm", "opening_mm", "closing_steps", "script", "tolerance"} <= set(edge["robots"][0])
        assert all(set(violation) == {"share", "quantity", "value", "allowed", "cause"} for violation in edge["violations"])
    assert (tmp_path / "audit.svg").read_text().count("adroit") >= len(names) - 1
    assert "0 turns or more; got -1" in refusal(capsys, "audit", "--targets", *names[1:], "--tries", "-1")
    assert "2 robots per edge or more" in refusal(capsys, "audit", "--targets", *names[1:], "--robots", "1")
