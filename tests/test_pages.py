"""The pages in docs/ and the README: their links lead somewhere, and they stay short."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from documented import PAGES, ROOT

HELP, ALL = 15_000, 35_000  # words: of the README and docs/*.md, and with docs/results/
CELL = 25  # words in a cell of a table
PICTURES = {".png", ".svg", ".webp"}


def prose(page: Path) -> str:
    """The text without blocks of code."""
    return re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)


def links(page: Path) -> list[str]:
    """What a page links to or shows in this repository, as PATH#ANCHOR."""
    found = re.findall(r"\]\(([^)\s]+)\)", re.sub(r"`[^`]*`", "", prose(page)))
    return [link for link in found if "://" not in link]


def anchors(page: Path) -> set[str]:
    """Of the headings, as GitHub makes them: lower case, without punctuation, hyphens between words."""
    headings = re.findall(r"^#+ (.*)$", prose(page), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_every_link_leads_to_a_file_and_a_heading(page: Path) -> None:
    for link in links(page):
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), link
        assert not anchor or anchor in anchors(target), link


def test_every_page_is_linked_and_every_picture_shown() -> None:
    named = {(page.parent / link.partition("#")[0]).resolve() for page in PAGES for link in links(page)}
    files = {path for path in (ROOT / "docs").rglob("*") if path.suffix in PICTURES | {".md"}}
    assert files <= named


def test_pages_keep_to_their_lengths() -> None:
    words = {page: len(page.read_text(encoding="utf-8").split()) for page in PAGES}
    assert sum(count for page, count in words.items() if page.parent.name != "results") <= HELP
    assert sum(words.values()) <= ALL


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_cells_of_tables_are_short(page: Path) -> None:
    rows = re.findall(r"^\|(.*)\|$", prose(page), re.MULTILINE)
    long = [cell for row in rows for cell in re.split(r"(?<!\\)\|", row) if len(cell.split()) > CELL]
    assert not long
