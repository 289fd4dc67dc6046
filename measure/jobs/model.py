"""What travels between the runner, its workers and the journal: paths, digests and small numbers, never arrays."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Literal

from drivers.files.disk import sha256_hex

RESULT_FORMAT = "spherecal-job-result/1"
DEAD_LETTER_FORMAT = "spherecal-dead-letter/1"
PartKind = Literal["session", "scans"]
_ID_DIGITS = 16
_WORK_VERSION = 1
"""Part of every job's digest: raise it when the same inputs and settings are to be measured anew."""


@dataclass(frozen=True, slots=True)
class Recipe:
    """What is done with every part; the same recipe on the same inputs is the same job."""

    calibration_id: str
    voxel_mm: float = 0.5
    clean_edges: bool = True
    cell_sha256: str | None = None
    """Of the cell file with which folders of scans and poses are read."""
    nominal_sha256: str | None = None
    """Of the mesh that clouds are compared with."""
    spec_sha256: str | None = None
    """Of the inspection.yaml."""
    correlation_sha256: str | None = None
    """Of the offsets to a reference gauge."""
    judge_corrected: bool = False
    """Whether what they name is judged by the corrected value."""

    @property
    def digest(self) -> str:
        """sha256 over all of it; a recipe without what later versions know is the one it was before them."""
        later = {"correlation_sha256": None, "judge_corrected": False}
        told = {name: value for name, value in asdict(self).items() if name not in later or value != later[name]}
        return _digest({"work": _WORK_VERSION, **told})


@dataclass(frozen=True, slots=True)
class Files:
    """Where a recipe's files lie, as copied beside the results: nobody changes them while jobs run."""

    calibration: Path
    cell: Path | None = None
    nominal: Path | None = None
    spec: Path | None = None
    correlation: Path | None = None
    judge_corrected: bool = False


@dataclass(frozen=True, slots=True)
class Job:
    """One part to be measured."""

    part: str
    """Name of its folder."""
    source: Path
    kind: PartKind
    input_digest: str
    """`Session.digest` of a session; of scans and poses, over the bytes of all of them."""
    fingerprint: str
    """Over names, sizes and times of the source's files: tells cheaply whether anything changed."""
    recipe_digest: str
    memory_mb: float
    """How much its worker is expected to take at most, the program included."""

    @property
    def id(self) -> str:
        """Digest of part, inputs and recipe; names its result."""
        return _digest({"part": self.part, "inputs": self.input_digest, "recipe": self.recipe_digest})[:_ID_DIGITS]

    @property
    def name(self) -> str:
        """The name of its result and of its dead letter."""
        return f"{self.part}-{self.id}"


@dataclass(frozen=True, slots=True)
class Order:
    """A job as it travels to a worker."""

    job: Job
    recipe: Recipe
    files: Files
    out: Path
    """The folder of results, journal and dead letters."""
    attempt: int
    n_threads: int = 1
    """Scans to work on at a time; changes no bit of the result."""
    history: str | None = None
    """Place of the cell's history; it is asked for the last quick check."""


@dataclass(frozen=True, slots=True)
class Failure:
    """Why an attempt came to nothing."""

    category: str
    """A few words under which failures are counted."""
    reason: str
    """One line: file, place, what was found."""
    transient: bool
    """Whether trying again may help."""
    remedy: str | None = None
    trace: str | None = None
    """Python's traceback, for errors nobody expected."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of an attempt: a failure, or a result on disk with these facts."""

    seconds: float
    worker: str
    failure: Failure | None = None
    facts: Mapping[str, object] = field(default_factory=dict)
    """verdict, marks, n_points and the like, for journal and page."""


Work = Callable[[Order], Outcome]
"""Does one job, in a process of its own, and raises nothing; a function of a module, since it travels by its name."""


def _digest(data: Mapping[str, object]) -> str:
    return sha256_hex(json.dumps(data, sort_keys=True, separators=(",", ":")).encode())
