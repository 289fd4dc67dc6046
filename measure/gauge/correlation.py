"""Correlation with a reference gauge (a CMM): an offset for each feature, with uncertainty, in a file of its own version.

The offset is the mean of reference minus value over parts measured by both; it corrects what is systematic between the two
(fixture, definition of the feature) and proves nothing about accuracy. It is therefore always shown beside the raw value.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drivers.errors import DataError, FileError
from drivers.files.disk import read_text, write_text_atomic
from drivers.files.yaml import dump_yaml, parse_yaml
from measure.gauge.table import Measured, by_feature

FORMAT = "spherecal-correlation/1"
_LEAST_PARTS = 3
_REMEDY = "Make it with `spherecal gauge correlation TABLE -o FILE`."


@dataclass(frozen=True, slots=True)
class Offset:
    """What is added to a feature's value."""

    offset_mm: float
    expanded_uncertainty_mm: float
    """Of the offset, 95 %, by Student's t over the parts."""
    scatter_mm: float
    """Standard deviation of single differences: how well one part agrees after the correction."""
    n_parts: int
    slope: float
    """Of reference over value, 1 where both see the same differences between parts."""
    slope_is_one: bool
    """Whether chance explains its distance from 1 (95 %)."""


@dataclass(frozen=True, slots=True)
class Correlation:
    """Offsets by feature."""

    offsets: dict[str, Offset]
    version: int = 1
    created_utc: str = ""
    note: str = ""

    @property
    def id(self) -> str:
        """Digest of what is corrected, without version, time and note."""
        content = {name: offset.offset_mm for name, offset in sorted(self.offsets.items())}
        return hashlib.sha256(json.dumps(content).encode()).hexdigest()


def correlate(rows: Sequence[Measured]) -> dict[str, Offset]:
    """Offsets of every feature that has `reference_mm`.

    Raises:
        DataError: no references, or fewer than three parts of a feature.
    """
    rows = [row for row in rows if row.reference_mm is not None]
    if not rows:
        raise DataError("no row has a reference_mm", remedy="Fill the column reference_mm with the reference gauge's values.")
    return {feature: _one(feature, members) for feature, members in by_feature(rows).items()}


def _one(feature: str, rows: Sequence[Measured]) -> Offset:
    from scipy import stats

    by_part: dict[str, list[Measured]] = {}
    for row in rows:
        by_part.setdefault(row.part, []).append(row)
    if len(by_part) < _LEAST_PARTS:
        raise DataError(
            f"{feature}: {len(by_part)} parts measured by both are too few", remedy=f"Take at least {_LEAST_PARTS} parts, named in the column part."
        )
    # repeats of a part share what is particular to it
    value = np.array([np.mean([row.value_mm for row in members]) for members in by_part.values()])
    reference = np.array([np.mean([row.reference_mm for row in members if row.reference_mm is not None]) for members in by_part.values()])
    difference, n = reference - value, len(by_part)
    scatter = float(difference.std(ddof=1))
    slope, same = 1.0, True
    if np.ptp(value) > 0:
        line = stats.linregress(value, difference)
        slope = float(1.0 + line.slope)
        same = bool(abs(line.slope) <= stats.t.ppf(0.975, n - 2) * line.stderr) if line.stderr > 0 else line.slope == 0
    return Offset(float(difference.mean()), float(stats.t.ppf(0.975, n - 1) * scatter / np.sqrt(n)), scatter, n, slope, same)


def save_correlation(correlation: Correlation, path: str | Path) -> Correlation:
    """Write a correlation; where the file holds another one, as its next version. Returns what was written.

    Raises:
        FileError: the file is there and no correlation, or cannot be written.
    """
    path = Path(path)
    version = load_correlation(path).version + 1 if path.exists() else 1
    made = Correlation(correlation.offsets, version, correlation.created_utc, correlation.note)
    features = {
        name: {
            "offset_mm": o.offset_mm,
            "expanded_uncertainty_mm": o.expanded_uncertainty_mm,
            "scatter_mm": o.scatter_mm,
            "n_parts": o.n_parts,
            "slope": o.slope,
            "slope_is_one": o.slope_is_one,
        }
        for name, o in made.offsets.items()
    }
    data = {"format": FORMAT, "version": made.version, "id": made.id, "created_utc": made.created_utc, "note": made.note, "features": features}
    write_text_atomic(path, dump_yaml(data))
    return made


def load_correlation(path: str | Path) -> Correlation:
    """Read a correlation.

    Raises:
        FileError: missing, broken, of another format, or changed by hand (its id does not fit).
    """
    data = parse_yaml(read_text(path), file=path)
    try:
        if not isinstance(data, dict) or data["format"] != FORMAT:
            raise FileError(f"is no {FORMAT} file", file=path, remedy=_REMEDY)
        offsets = {
            str(name): Offset(
                float(o["offset_mm"]),
                float(o["expanded_uncertainty_mm"]),
                float(o["scatter_mm"]),
                int(o["n_parts"]),
                float(o["slope"]),
                bool(o["slope_is_one"]),
            )
            for name, o in data["features"].items()
        }
        made = Correlation(offsets, int(data["version"]), str(data["created_utc"]), str(data.get("note", "")))
        said = str(data["id"])
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise FileError(f"is broken: {error!r}", file=path, remedy=_REMEDY) from error
    if said != made.id:
        raise FileError("was changed by hand: its id does not fit its offsets", file=path, where="id", remedy=_REMEDY)
    return made
