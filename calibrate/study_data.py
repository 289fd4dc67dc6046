"""What the study hands out: plain tables, and figures made of panels and curves; ready for CSV, JSON, plots and a page."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drivers.kinematics.se3 import FloatArray

Cell = str | float | int | None
"""One cell of a table; None where there is nothing to say."""


@dataclass(frozen=True, slots=True)
class StudyTable:
    """One table; names of columns carry their units."""

    name: str
    """Stem of its file."""
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]

    def column(self, name: str) -> list[Cell]:
        """All cells of a column."""
        index = self.columns.index(name)
        return [row[index] for row in self.rows]

    def row(self, key: Cell) -> dict[str, Cell]:
        """The row whose first cell is `key`, by column."""
        return next(dict(zip(self.columns, row, strict=True)) for row in self.rows if row[0] == key)


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """Points (n,) of one curve."""

    label: str
    x: FloatArray
    y: FloatArray
    dots: bool = False
    """Drawn as dots instead of a line."""


@dataclass(frozen=True, slots=True, eq=False)
class Panel:
    """One pair of axes."""

    title: str
    x_label: str
    y_label: str
    curves: tuple[Curve, ...]
    log_y: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class StudyFigure:
    """One figure."""

    name: str
    """Stem of its files."""
    panels: tuple[Panel, ...]


@dataclass(frozen=True, slots=True)
class Spread:
    """How measured centres (m, 3) of a still sphere lie, in mm."""

    e_mean_mm: float
    """The paper's: mean distance from the true place. Mostly the datum, which no such data fix."""
    e_max_mm: float
    std_mm: float
    """The paper's: standard deviation of that distance."""
    rms_about_mean_mm: float
    """Root of the mean squared distance from their own mean: what a calibration is good for."""


def spread_of(centres_in_base_mm: FloatArray, true_centre_in_base_mm: FloatArray) -> Spread:
    """The figures of Table 3 for centres (m, 3)."""
    error = np.linalg.norm(centres_in_base_mm - true_centre_in_base_mm, axis=1)
    about_mean = centres_in_base_mm - centres_in_base_mm.mean(axis=0)
    return Spread(float(error.mean()), float(error.max()), float(error.std()), float(np.sqrt((about_mean**2).sum(axis=1).mean())))


def medians(rows: list[tuple[Cell, ...]]) -> tuple[Cell, ...]:
    """Cell by cell medians of rows of one shape; texts must be the same in all."""
    return tuple(cells[0] if isinstance(cells[0], str) or cells[0] is None else _median(cells) for cells in zip(*rows, strict=True))


def _median(cells: tuple[Cell, ...]) -> float:
    return float(np.median([float(cell) for cell in cells if cell is not None]))
