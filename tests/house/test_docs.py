"""The pages point at things that exist."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from acquire.cell import load_cell
from drivers.files.shots import read_shots
from drivers.models import parse_robot_model
from measure.inspecting.spec import load_spec
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


def test_the_readme_names_every_command_and_no_other() -> None:
    from typer.main import get_group

    from measure.cli import app

    verbs = set(get_group(app).commands)
    named = set(re.findall(r"`spherecal ([a-z]+(?:-[a-z]+)*)", (ROOT / "README.md").read_text(encoding="utf-8")))
    assert named == verbs


def example(kind: str, containing: str) -> str:
    """A fenced example of the page on file formats."""
    text = (ROOT / "docs" / "file_formats.md").read_text(encoding="utf-8")
    blocks: list[str] = re.findall(rf"```{kind}\n(.*?)```", text, re.DOTALL)
    return next(block for block in blocks if containing in block)


def test_the_cell_file_of_the_page_loads(tmp_path: Path) -> None:
    path = tmp_path / "cell.yaml"
    path.write_text(example("yaml", "spherecal-cell/1"), encoding="utf-8")
    assert set(load_cell(path).spheres) == {"A", "B"}


def test_the_robot_model_of_the_page_loads() -> None:
    assert parse_robot_model(example("yaml", "spherecal-robot/1"), file="page").name == "two_links"


def test_the_shot_of_the_page_loads(tmp_path: Path) -> None:
    line = example("json", "joints_rad").replace('"..."', f'"{"0" * 64}"')
    (tmp_path / "scans").mkdir()
    (tmp_path / "scans" / "0000.ply").touch()
    (tmp_path / "shots.jsonl").write_text(line, encoding="utf-8")
    (shot,) = read_shots(tmp_path)
    assert shot.sphere == "A"


def test_the_inspection_file_of_the_page_loads(tmp_path: Path) -> None:
    path = tmp_path / "inspection.yaml"
    path.write_text(example("yaml", "spherecal-inspection/1"), encoding="utf-8")
    assert len(load_spec(path).features) == 6
