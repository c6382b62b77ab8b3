"""docs/extend.md names files that exist."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "extend.md").read_text(encoding="utf-8")


def test_every_file_that_the_page_names_is_there():
    names = [name for name in re.findall(r"`([\w/]+(?:\.py|/))`", PAGE) if "/" in name]
    assert len(names) > 15
    assert not [name for name in names if not (ROOT / name).exists()]
    links = re.findall(r"\]\(([\w-]+\.md)\)", PAGE)
    assert links and not [link for link in links if not (ROOT / "docs" / link).is_file()]


def test_every_name_that_the_page_asks_for_is_where_it_says():
    for word, file in {"LAWS": "toolkit/simulation/laws.py", "ModelTask": "tasks/task.py", "Scene": "tasks/task.py",
                       "ModelRobot": "robots/model_robot.py", "element": "robots/model_robot.py", "PickTask": "tasks/pick.py"}.items():
        assert word in PAGE and re.search(rf"\b{word}\b", (ROOT / file).read_text(encoding="utf-8"))
