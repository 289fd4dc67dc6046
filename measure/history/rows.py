"""What the history keeps, as plain rows; none of them is ever changed."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

ResultKind = Literal["check", "verification", "inspection"]


@dataclass(frozen=True, slots=True)
class CalibrationRow:
    """One calibration, its file included."""

    id: str
    cell: str
    recorded_utc: str
    created_utc: str
    verdict: str
    parent: str | None
    """The calibration of which it solved a few parameters anew."""
    file: str
    """Where it lay when it was recorded."""


@dataclass(frozen=True, slots=True)
class ResultRow:
    """One check, verification or inspection made with a calibration."""

    number: int
    cell: str
    kind: str
    calibration: str
    recorded_utc: str
    taken_utc: str
    verdict: str
    software: str
    content: str
    """The JSON object that the command printed."""

    @property
    def data(self) -> Mapping[str, object]:
        """`content` as data."""
        found = json.loads(self.content)
        return found if isinstance(found, dict) else {}

    @property
    def changed(self) -> str:
        """What a check named as changed, in words; nothing where it named nothing, or is no check."""
        data = self.data
        since = data.get("since")
        told = _causes(data)
        if told or not isinstance(since, Mapping) or not _causes(since):
            return told
        return f"{_causes(since)} since {since.get('earlier')}"

    @property
    def remark(self) -> str:
        """What nobody may read of it without: that training data were used."""
        return str(self.data.get("remark", ""))


def _causes(data: Mapping[str, object]) -> str:
    together, named = data.get("together"), data.get("named")
    pairs = together.get("pairs") if isinstance(together, Mapping) else None
    if isinstance(pairs, list):
        return " or ".join(" and ".join(map(str, pair["causes"])) for pair in pairs)
    return " or ".join(map(str, named)) if isinstance(named, list) else ""


@dataclass(frozen=True, slots=True)
class ActivationRow:
    """From when on a cell uses a calibration."""

    number: int
    cell: str
    calibration: str
    at_utc: str
    who: str
    why: str
    forced: bool
    """Whether a failed calibration was taken knowingly."""
