"""What `spherecal study` writes: a CSV a table and a figure, a PNG a figure, and one self-contained study.html."""

from __future__ import annotations

import base64
import csv
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from calibrate.study import Study
from calibrate.study_data import Cell, StudyFigure, StudyTable
from drivers.files.disk import write_text_atomic
from measure.study_plots import figure_png
from measure.study_text import SECTIONS, Section, head_of

PAGE = "study.html"
_MARK = "<!-- spherecal-study/1 -->"


@dataclass(frozen=True, slots=True)
class PageTable:
    """A table as text."""

    heads: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    words: tuple[bool, ...]
    """Which columns hold words."""


@dataclass(frozen=True, slots=True)
class PageSection:
    """A section with its tables and pictures."""

    words: Section
    tables: tuple[PageTable, ...]
    pictures: tuple[str, ...]
    """PNG as base64."""


def write_study(study: Study, folder: Path) -> Path:
    """Write all files of a study into an existing folder; returns the page.

    Raises:
        FileError: the folder is not writable.
    """
    pictures = {figure.name: figure_png(figure) for figure in study.figures}
    for table in study.tables:
        write_text_atomic(folder / f"{table.name}.csv", table_csv(table))
    for figure in study.figures:
        # a sweep has its table and its figure under one name
        write_text_atomic(folder / f"{figure.name}_curves.csv", figure_csv(figure))
        (folder / f"{figure.name}.png").write_bytes(pictures[figure.name])
    write_text_atomic(folder / PAGE, render(study, pictures))
    return folder / PAGE


def is_study(folder: Path) -> bool:
    """Whether a folder holds what `write_study` wrote."""
    page = folder / PAGE
    return page.is_file() and _MARK in page.read_text(encoding="utf-8", errors="replace")[:400]


def table_csv(table: StudyTable) -> str:
    """A table with its full precision."""
    return _csv(table.columns, table.rows)


def figure_csv(figure: StudyFigure) -> str:
    """All curves of a figure, a point a line."""
    rows = ((p.title, c.label, float(x), float(y)) for p in figure.panels for c in p.curves for x, y in zip(c.x, c.y, strict=True))
    return _csv(("panel", "curve", "x", "y"), rows)


def tables_as_data(study: Study) -> dict[str, object]:
    """For `--json`: every table as a list of objects."""
    return {table.name: [dict(zip(table.columns, row, strict=True)) for row in table.rows] for table in study.tables}


def render(study: Study, pictures: dict[str, bytes]) -> str:
    """The page as HTML; every text on it is escaped."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(loader=PackageLoader("measure"), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    sections = [
        PageSection(
            section,
            tuple(_page_table(study.table(name)) for name in section.tables),
            tuple(base64.b64encode(pictures[name]).decode("ascii") for name in section.figures),
        )
        for section in SECTIONS
    ]
    template = environment.get_template("study.html.j2")
    settings = study.settings
    how = (
        f"seed {settings.seed}; Table 3 over {settings.repeats} draws, clouds over {settings.cloud_repeats}, sweeps over {settings.sweep_repeats}; "
        f"L = {settings.max_sweeps}; {study.seconds:.0f} s"
    )
    return template.render(sections=sections, sentence=headline(study), how=how, software=f"spherecal {version('spherecal')}")


def headline(study: Study) -> str:
    """The finding in one sentence, with this run's figures."""
    centres, clouds = study.table("table3").rows, study.table("table3_clouds").rows
    column, noisy = study.table("table3").columns, study.table("table3_clouds").columns
    stepwise, none = centres[0][column.index("rms_about_mean_mm")], centres[2][column.index("rms_about_mean_mm")]
    fitted, points = clouds[0][noisy.index("rms_about_mean_mm")], clouds[-1][noisy.index("rms_about_mean_mm")]
    return (
        f"On its own simulation the paper's method 1 takes the spread of a still sphere from {_short(none)} mm to {_short(stepwise)} mm rms; "
        f"where the sphere is seen as a cloud, fitted centres give {_short(fitted)} mm and a solve on the points {_short(points)} mm."
    )


def _short(cell: Cell) -> str:
    return f"{cell:.3f}" if isinstance(cell, float) else _text(cell)


def _page_table(table: StudyTable) -> PageTable:
    words = tuple(any(isinstance(cell, str) for cell in table.column(name)) for name in table.columns)
    return PageTable(tuple(head_of(name) for name in table.columns), tuple(tuple(_text(cell) for cell in row) for row in table.rows), words)


def _text(cell: Cell) -> str:
    if cell is None:
        return "-"
    if isinstance(cell, str):
        return cell
    size = abs(cell)
    if size != 0 and size < 5e-4:
        return f"{cell:.0e}"
    return f"{cell:.4f}" if size < 0.1 else f"{cell:.3f}" if size < 10 else f"{cell:.1f}"


def _csv(columns: Sequence[str], rows: Iterable[Sequence[Cell]]) -> str:
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    return stream.getvalue()
