"""The documentation as pages to browse, from README.md and docs/*.md: `make docs`, then open build/site/index.html.

Markdown by markdown-it-py, which comes with the toolkit (the terminal's tables need it); nothing is fetched, and no server is needed.
"""

import html
import re
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

from markdown_it import MarkdownIt
from markdown_it.token import Token

ROOT = Path(__file__).parents[1]
SECTIONS = {
    "Start": ("README.md", "docs/inspect.md"),
    "How to": ("docs/python.md", "docs/add-a-robot.md", "docs/extend.md", "docs/dexycb.md", "docs/demonstrations.md", "docs/deploy.md"),
    "Explanation": ("docs/how-transfer-works.md", "docs/ant-maze.md", "docs/architecture.md"),
    "Reference": ("docs/results.md", "CHANGELOG.md", "CONTRIBUTING.md"),
}
"""What a reader wants of a page -> the pages (Diataxis); a page of docs/ that is not listed stands under "More"."""
STYLE = """
:root { color-scheme: light; } body { margin: 0; font: 16px/1.55 system-ui, sans-serif; color: #111; background: #fff; }
nav { padding: 1rem; background: #f4f4f4; } nav a { display: block; padding: .1rem 0; } nav b { display: block; margin-top: .8rem; }
main { max-width: 54rem; padding: 1rem; overflow-wrap: break-word; } img { max-width: 100%; height: auto; }
pre { overflow-x: auto; background: #f4f4f4; padding: .6rem; font-size: .85rem; } code { font-size: .9em; }
table { display: block; overflow-x: auto; border-collapse: collapse; } th, td { border-bottom: 1px solid #ccc; padding: .3rem .6rem; }
th { border-bottom: 2px solid #111; } th, td { text-align: left; vertical-align: top; } a { color: #0b57a4; }
@media (min-width: 60rem) { body { display: grid; grid-template-columns: 15rem 1fr; } nav { min-height: 100vh; } }
"""


def build(out: Path) -> list[Path]:
    """Write the pages and their pictures.

    Args:
        out: folder; made where it is missing.

    Returns:
        The pages.
    """
    pages = {ROOT / name: section for section, names in SECTIONS.items() for name in names if (ROOT / name).is_file()}
    pages |= {file: "More" for file in sorted((ROOT / "docs").glob("*.md")) if file not in pages}
    titles = {file: _title(file.read_text(encoding="utf-8")) for file in pages}
    markdown = MarkdownIt("commonmark").enable("table")
    written = []
    for file in pages:
        tokens = markdown.parse(file.read_text(encoding="utf-8"))
        for token in _flat(tokens):
            _point(token, file, pages, out)
        _anchor(tokens)
        text = markdown.renderer.render(tokens, markdown.options, {})
        target = out / _address(file)
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(_page(titles[file], _navigation(file, pages, titles), text), encoding="utf-8")
        written.append(target)
    return written


def _title(text: str) -> str:
    return next((line.removeprefix("# ").strip() for line in text.splitlines() if line.startswith("# ")), "meta-evolve")


def _address(file: Path) -> str:
    """Of a page in the site; all of them lie in one folder."""
    return "index.html" if file.name == "README.md" else f"{file.stem.lower()}.html"


def _flat(tokens: list[Token]) -> Iterator[Token]:
    for token in tokens:
        yield token
        yield from token.children or ()


def _point(token: Token, file: Path, pages: dict[Path, str], out: Path) -> None:
    """Let a link or a picture point into the site; pictures are copied there, and other files stay where they are."""
    key = {"link_open": "href", "image": "src"}.get(token.type)
    link = str(token.attrGet(key) or "") if key else ""
    if not link or link.startswith("#") or re.match(r"[a-z]+:", link):
        return
    place, _, anchor = link.partition("#")
    meant = (file.parent / place).resolve()
    if meant in pages:
        token.attrSet(key, _address(meant) + (f"#{anchor}" if anchor else ""))
    elif token.type == "image":
        (out / "images").mkdir(parents=True, exist_ok=True)
        shutil.copyfile(meant, out / "images" / meant.name)
        token.attrSet(key, f"images/{meant.name}")
    elif meant.exists():
        token.attrSet(key, meant.as_uri())


def _anchor(tokens: list[Token]) -> None:
    """Give headings the names by which links call them, as GitHub does."""
    for token, content in zip(tokens, tokens[1:], strict=False):
        if token.type == "heading_open":
            words = "".join(child.content for child in content.children or ())
            token.attrSet("id", re.sub(r"[^\w\- ]", "", words.lower()).replace(" ", "-"))


def _navigation(here: Path, pages: dict[Path, str], titles: dict[Path, str]) -> str:
    lines, before = [], None
    for file, section in pages.items():
        lines += [f"<b>{html.escape(section)}</b>"] if section != before else []
        before = section
        current = ' aria-current="page"' if file == here else ""
        lines.append(f'<a href="{_address(file)}"{current}>{html.escape(titles[file])}</a>')
    return "\n".join(lines)


def _page(title: str, navigation: str, text: str) -> str:
    head = f'<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1"><title>{html.escape(title)}</title>'
    return (f'<!DOCTYPE html>\n<html lang="en"><head>{head}<style>{STYLE}</style></head>\n'
            f"<body>\n<nav>\n{navigation}\n</nav>\n<main>\n{text}</main>\n</body></html>\n")


if __name__ == "__main__":
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else ROOT / "build" / "site")
    sys.stdout.write(f"{len(build(folder))} pages; open {folder / 'index.html'}\n")
