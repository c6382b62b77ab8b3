"""The documentation as pages: all of it is there, and every link and picture leads somewhere."""

import importlib.util
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    """Address -> text of every page."""
    spec = importlib.util.spec_from_file_location("site_of_docs", ROOT / "docs" / "site.py")
    site = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(site)
    folder = tmp_path_factory.mktemp("site")
    return {page: page.read_text(encoding="utf-8") for page in site.build(folder)}


def test_every_page_of_the_documentation_is_there(pages):
    names = {page.name for page in pages}
    assert {f"{file.stem}.html" for file in (ROOT / "docs").glob("*.md")} | {"index.html", "contributing.html"} <= names
    for text in pages.values():
        assert all(f'href="{name}"' in text for name in names), "each leads to all others"
        assert "<table>" in text or "|---|" not in text, "tables are tables"


def test_no_link_or_picture_leads_nowhere(pages):
    lost = []
    for page, text in pages.items():
        for link in re.findall(r'(?:href|src)="([^"]+)"', text):
            if re.match(r"(https?|mailto|file):", link):
                continue
            place, _, anchor = link.partition("#")
            target = page.parent / place if place else page
            if not target.is_file() or (anchor and f'id="{anchor}"' not in pages.get(target, "")):
                lost.append((page.name, link))
    assert lost == []


def test_the_paper_can_be_cited():
    import yaml

    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert cited["cff-version"] == "1.2.0" and cited["message"] and cited["title"] == "meta-evolve"
    paper = cited["references"][0]
    assert paper["title"].startswith("Meta-Evolve") and [author["family-names"] for author in paper["authors"]] == ["Liu", "Pathak", "Zhao"]
    assert paper["year"] == 2024
