"""Values as a Q-DAS ASCII transfer file (DFQ): K-fields of the part and its characteristics, then one line of values a part.

Values of a line are separated by the character 0x0F, what belongs to a value (attribute, time) by 0x14, as in the format's manual.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

from drivers.errors import DataError
from drivers.files.disk import write_atomic
from measure.gauge.table import Measured, by_feature, time_of

_BETWEEN_VALUES, _WITHIN_VALUE = "\x0f", "\x14"
_DECIMALS = 4
_LINE = re.compile(r"[\x00-\x1f]+")
_VALID, _MISSING = 0, 256


def dfq_text(rows: Sequence[Measured], *, part_number: str, part_name: str = "", gauge: str = "", machine: str = "") -> str:
    """The file's text.

    Args:
        rows: values; those of one part, operator, trial, direction and time share a line.
        part_number: K1001.
        part_name: K1002.
        gauge: K2402 of every characteristic.
        machine: K1010 of the part: where it was measured.

    Raises:
        DataError: no values, or two of one feature for the same line.
    """
    features = by_feature(rows)
    if not features:
        raise DataError("there are no values to write", remedy="Give at least one.")
    lines = [f"K0100 {len(features)}", f"K1001 {_plain(part_number)}"]
    lines += [f"K1002 {_plain(part_name)}"] if part_name else []
    lines += [f"K1010 {_plain(machine)}"] if machine else []
    for i, (feature, members) in enumerate(features.items(), start=1):
        lines += _characteristic(i, feature, members[0], gauge)
    return "\r\n".join([*lines, *_value_lines(rows, list(features))]) + "\r\n"


def _characteristic(i: int, feature: str, row: Measured, gauge: str) -> list[str]:
    lines = [f"K2001/{i} {i}", f"K2002/{i} {_plain(feature)}", f"K2022/{i} {_DECIMALS}"]
    lines += [f"K2101/{i} {row.nominal_mm:.{_DECIMALS}f}"] if row.nominal_mm is not None else []
    lines += [f"K2110/{i} {row.lower_mm:.{_DECIMALS}f}"] if row.lower_mm is not None else []
    lines += [f"K2111/{i} {row.upper_mm:.{_DECIMALS}f}"] if row.upper_mm is not None else []
    return [*lines, f"K2142/{i} mm", *([f"K2402/{i} {_plain(gauge)}"] if gauge else [])]


def _value_lines(rows: Sequence[Measured], features: Sequence[str]) -> list[str]:
    lines: dict[tuple[str, ...], dict[str, Measured]] = {}
    for row in rows:
        line = lines.setdefault((row.part, row.operator, row.trial, row.direction, str(row.minutes), row.time_utc), {})
        if row.feature in line:
            raise DataError(f"{row.feature} is there twice for {row.part or 'a part'}", remedy="Name part, operator, trial or time_utc in the table.")
        line[row.feature] = row
    return [_BETWEEN_VALUES.join(_value(line.get(feature), time) for feature in features) for (*_, time), line in lines.items()]


def _value(row: Measured | None, time: str) -> str:
    when = f"{_WITHIN_VALUE}{_german_time(time)}" if time else ""
    if row is None:
        return f"0{_WITHIN_VALUE}{_MISSING}{when}"
    return f"{row.value_mm:.{_DECIMALS + 1}f}{_WITHIN_VALUE}{_VALID}{when}"


def _german_time(text: str) -> str:
    time = time_of(text, "table", "time_utc")
    in_utc = time.astimezone(UTC) if time.tzinfo else time
    return datetime.strftime(in_utc, "%d.%m.%Y/%H:%M:%S")


def _plain(text: str) -> str:
    """One line: a line break would begin another field."""
    return _LINE.sub(" ", text).strip()[:80]


def write_dfq(text: str, path: str | Path) -> None:
    """Write it in the character set that its readers expect, what that lacks as question marks."""
    write_atomic(path, text.encode("cp1252", errors="replace"))
