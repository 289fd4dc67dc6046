"""The pages point at things that exist."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.support.source import ROOT

PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", ROOT / "THIRD_PARTY.md", *sorted((ROOT / "docs").rglob("*.md"))]
LINK = re.compile(r"\]\((?!https?:)([^)#]+)(?:#[^)]*)?\)")


def name_of(page: Path) -> str:
    """A page's path in the repository."""
    return str(page.relative_to(ROOT))


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_lead_somewhere(page: Path) -> None:
    targets = LINK.findall(page.read_text(encoding="utf-8"))
    assert not [target for target in targets if not (page.parent / target).exists()]


def test_every_page_of_docs_is_in_the_index() -> None:
    index = ROOT / "docs" / "index.md"
    linked = {(index.parent / target).resolve() for target in LINK.findall(index.read_text(encoding="utf-8"))}
    assert not [name_of(page) for page in (ROOT / "docs").rglob("*.md") if page != index and page.resolve() not in linked]


def test_files_that_pages_name_exist() -> None:
    """Paths in back quotes that look like files of ours."""
    named = re.compile(r"`((?:drivers|acquire|calibrate|measure|tests|docs|tools)/[\w./-]+\.\w+)`")
    missing = {(name_of(page), path) for page in PAGES for path in named.findall(page.read_text(encoding="utf-8")) if not (ROOT / path).exists()}
    assert not missing
