"""Which failures are worth another try, and under which words they are counted."""

from __future__ import annotations

import errno
import re
import traceback
from pathlib import Path

from drivers.errors import SpherecalError
from measure.jobs.model import Failure

WORKER_DIED = "worker died"
TIMED_OUT = "took too long"
TOO_LARGE = "too large for the memory"
UNFINISHED = "never completed"
_LONGEST_CATEGORY = 80

_PASSING = frozenset(
    getattr(errno, name)
    for name in (
        *("EIO", "EAGAIN", "EBUSY", "EINTR", "ENOSPC", "EDQUOT", "ENOMEM", "EMFILE", "ENFILE", "ETXTBSY", "ENOLCK"),
        *("ESTALE", "ETIMEDOUT", "EHOSTDOWN", "EHOSTUNREACH", "ENETDOWN", "ENETUNREACH", "ECONNRESET", "ECONNREFUSED", "EPIPE", "ENOTCONN"),
    )
    if hasattr(errno, name)
)
"""Troubles of disks and networks that pass: a share that went away, a full disk, too many open files."""


def failure_of(error: BaseException) -> Failure:
    """Judge an error that ended an attempt.

    Transient are troubles of the machine (memory, disk, network share), found in the error or in what caused it. Permanent
    is whatever the input, the settings or a bug brought about: the next attempt would meet it again.
    """
    passing = next((cause for cause in _chain(error) if _passes(cause)), None)
    if isinstance(error, MemoryError) or isinstance(passing, MemoryError):
        return Failure("out of memory", _line(error) or "no memory left", transient=True, remedy="Fewer --workers, or a coarser --voxel.")
    if isinstance(error, SpherecalError):
        category = "disk or network" if passing else category_of(error)
        return Failure(category, _told(error), transient=passing is not None, remedy=error.remedy)
    if isinstance(error, OSError):
        category = "disk or network" if passing else "file"
        return Failure(category, _line(error), transient=passing is not None, remedy="Check the disk, the share and the permissions.")
    trace = "".join(traceback.format_exception(error))
    return Failure("unexpected error", _line(error), transient=False, remedy="This is a bug in spherecal: report the traceback.", trace=trace)


def category_of(error: SpherecalError) -> str:
    """The kind of file and the beginning of the message, numbers left out: alike for all parts with the same trouble.

    For example `shots.jsonl: broken JSON` or `N.ply: is cut off`.
    """
    name = "" if error.file is None else Path(error.file).name
    words = re.split(r"[:,(]", error.message, maxsplit=1)[0]
    text = f"{name}: {words}" if "." in name else words
    return " ".join(re.sub(r"\d+(\.\d+)?", "N", text).split())[:_LONGEST_CATEGORY]


def _told(error: SpherecalError) -> str:
    """One line: file, place, what was found; the remedy stands beside it."""
    place = ", ".join(part for part in (error.file, error.where) if part)
    return " ".join((f"{place}: {error.message}" if place else error.message).split())


def _passes(error: BaseException) -> bool:
    return isinstance(error, MemoryError) or (isinstance(error, OSError) and error.errno in _PASSING)


def _chain(error: BaseException) -> list[BaseException]:
    """The error and what it was raised from."""
    found: list[BaseException] = []
    current: BaseException | None = error
    while current is not None and current not in found:
        found.append(current)
        current = current.__cause__
    return found


def _line(error: BaseException) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())}".rstrip(": ")
