"""Costly things made once a run of pytest, however many workers share it: what only looks at them need not make them again."""

from __future__ import annotations

import fcntl
import os
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import pytest

Made = TypeVar("Made")


def once_a_run(tmp_path_factory: pytest.TempPathFactory, name: str, make: Callable[[Path], Made]) -> Made:
    """What `make` gives, called in one process of the run with an empty folder; the others wait for it and read a copy.

    Args:
        tmp_path_factory: of the session.
        name: of the thing; the same name is the same thing.
        make: gets a folder that stays; what it gives is pickled.
    """
    base = tmp_path_factory.getbasetemp()
    # workers of pytest-xdist have folders of their own in that of the run
    shared = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "once" / name
    shared.mkdir(parents=True, exist_ok=True)
    kept = shared / "made.pickle"
    with (shared / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not kept.exists():
            folder = shared / "folder"
            folder.mkdir()
            kept.write_bytes(pickle.dumps(make(folder)))
    made: Made = pickle.loads(kept.read_bytes())
    return made
