"""Folders of results that appear whole or not at all, dead letters, and what killed attempts leave behind.

* `OUT/journal.jsonl`: what happened (`measure.jobs.journal`)
* `OUT/results/PART-DIGEST/`: result.json, cloud.ply, ...
* `OUT/dead_letters/PART-DIGEST.json`: why a part came to nothing
* `OUT/recipe/DIGEST-calibration.yaml`: the files that every job was done with
* `OUT/work/`: attempts that are not finished
"""

from __future__ import annotations

import fcntl
import os
import shutil
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from errno import EEXIST, ENOTEMPTY
from pathlib import Path

from drivers.errors import FileError
from drivers.files.disk import read_bytes, read_text, sha256_hex, sync_folder, write_atomic, write_text_atomic
from measure.console import json_text

RESULTS, DEAD_LETTERS, RECIPE, WORK = "results", "dead_letters", "recipe", "work"
RESULT_FILE = "result.json"
_ABANDONED_AFTER_S = 24 * 3600.0


def prepare(out: Path) -> None:
    """Make the folders of results.

    Raises:
        FileError: they cannot be made.
    """
    try:
        for name in (RESULTS, DEAD_LETTERS, RECIPE, WORK):
            (out / name).mkdir(parents=True, exist_ok=True)
        sync_folder(out)
    except OSError as error:
        raise FileError(f"cannot be made ({error.strerror or error})", file=out, remedy="Name another folder with -o.") from error


def keep_copy(out: Path, path: Path) -> tuple[Path, str]:
    """Copy a file of the recipe beside the results, named by its digest.

    Returns:
        The copy, which nobody changes, and the sha256 of its content.

    Raises:
        FileError: it cannot be read, or the copy cannot be written.
    """
    data = read_bytes(path)
    digest = sha256_hex(data)
    copy = (out / RECIPE).absolute() / f"{digest[:16]}-{path.name}"
    if not copy.exists():
        write_atomic(copy, data)
    return copy, digest


def result_folder(out: Path, name: str) -> Path:
    """Where the result of a job goes."""
    return out / RESULTS / name


def read_result(folder: Path) -> str | None:
    """The text of a result's result.json; None where there is no result."""
    with suppress(FileError):
        return read_text(folder / RESULT_FILE)
    return None


@contextmanager
def attempt_folder(out: Path, name: str) -> Iterator[Path]:
    """A folder of this attempt alone, gone afterwards unless `commit` has moved it.

    It is locked as long as the process lives, so that a later runner knows what a kill left behind (`clear_abandoned`).
    """
    working = Path(tempfile.mkdtemp(prefix=f"{name}.", suffix=".tmp", dir=out / WORK))
    working.chmod(0o755)
    descriptor = os.open(working, os.O_RDONLY)
    try:
        with suppress(OSError):  # shares without locks on folders: `clear_abandoned` goes by age there
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield working
    finally:
        os.close(descriptor)
        shutil.rmtree(working, ignore_errors=True)


def commit(working: Path, final: Path) -> bool:
    """Give a finished attempt its name in one step, everything on disk before; False where another attempt was first.

    Raises:
        OSError: the disk.
    """
    for root, _folders, names in os.walk(working):
        for name in names:
            _sync_file(Path(root) / name)
        sync_folder(root)
    try:
        os.rename(working, final)  # onto a folder that holds something this fails: it replaces nothing
    except OSError as error:
        if error.errno in (EEXIST, ENOTEMPTY):
            return False
        raise
    sync_folder(final.parent)
    return True


def clear_abandoned(out: Path, name: str = "*") -> int:
    """Remove attempts whose process is gone, of one job or of all; the number of them."""
    n_removed = 0
    for working in (out / WORK).glob(f"{name}.*.tmp"):
        if working.is_dir() and _is_abandoned(working):
            shutil.rmtree(working, ignore_errors=True)
            n_removed += 1
    return n_removed


def _is_abandoned(working: Path) -> bool:
    try:
        descriptor = os.open(working, os.O_RDONLY)
    except OSError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return time.time() - working.stat().st_mtime > _ABANDONED_AFTER_S
    finally:
        os.close(descriptor)
    return True


def write_dead_letter(out: Path, name: str, data: Mapping[str, object]) -> Path:
    """Say in a file why a job came to nothing.

    Raises:
        FileError: it cannot be written.
    """
    path = out / DEAD_LETTERS / f"{name}.json"
    write_text_atomic(path, json_text(data) + "\n")
    return path


def remove_dead_letter(out: Path, name: str) -> None:
    """Take a dead letter back: its part was measured after all, or was replaced by a better one."""
    with suppress(FileNotFoundError):
        (out / DEAD_LETTERS / f"{name}.json").unlink()


def _sync_file(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
