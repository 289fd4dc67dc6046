"""What a calibration was made from, and on which cell: for its file and for whoever doubts it."""

from __future__ import annotations

from collections.abc import Sequence

from acquire.cell import Cell
from drivers.files.session import Session


def inputs_of(cell: Cell, sessions: Sequence[Session]) -> dict[str, object]:
    """Names and digests of the sessions, the digest of their cell file, and the drivers that robot and camera were used by."""
    return {
        "sessions": [{"folder": s.folder.name, "digest": s.digest} for s in sessions],
        "cell_sha256": cell.sha256,
        "drivers": {"robot": cell.robot.driver, "camera": cell.camera.driver},
    }


def identity_of(cell: Cell, sessions: Sequence[Session]) -> dict[str, object]:
    """Serial numbers and the like: what the cell file says, and what each session found after it."""
    return dict(cell.identity) | {key: value for s in sessions for key, value in s.identity.items()}
