"""Work for workers of jobs, light to import: what a part's name asks for, and a stand-in that measures nothing."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

from measure.jobs.failures import failure_of
from measure.jobs.model import Failure, Order, Outcome
from measure.jobs.outputs import RESULT_FILE, attempt_folder, commit, result_folder

LIGHT_RESULT = '{"verdict": null, "marks": [], "stitch": {"n_scans": 2, "n_points": 1, "n_points_in": 1}, "session": "DIGEST"}'


def n_attempts(order: Order) -> int:
    """Counts in a file, since workers die; this attempt included."""
    count = order.out / f"attempts-{order.job.part}"
    with count.open("a", encoding="utf-8") as stream:
        stream.write("x")
    return len(count.read_text(encoding="utf-8"))


def moody(order: Order) -> Outcome:
    """Does what the part's name asks for."""
    word, n = order.job.part.split("-")[0], n_attempts(order)
    if word == "dies" or (word == "dies_once" and n == 1):
        os.kill(os.getpid(), signal.SIGKILL)
    if word == "hangs_once" and n == 1:
        time.sleep(60)
    if word == "raises":
        raise LookupError("a bug")
    if word == "fails" or (word == "passes" and n < 3):
        return Outcome(0.0, "here", failure=Failure("disk or network", "the share is gone", transient=True))
    return Outcome(0.0, "here", facts={"verdict": None, "marks": []})


def dying_at_work(order: Order) -> Outcome:
    """Ends in the middle of an attempt."""
    with attempt_folder(order.out, order.job.name):
        os.kill(os.getpid(), signal.SIGKILL)
    return Outcome(0.0, "here")


def moody_at_work(order: Order) -> Outcome:
    """As `light`, but parts called `dies` end their worker in the middle of it."""
    return dying_at_work(order) if order.job.part.startswith("dies") else light(order)


def light(order: Order) -> Outcome:
    """Reads everything and writes a result as the real work does, but makes no cloud."""
    try:
        with attempt_folder(order.out, order.job.name) as working:
            time.sleep(0.02)
            from drivers.files.session import read_scan, read_session

            session = read_session(order.job.source)
            for shot in session.shots:
                (working / Path(str(shot.scan)).name).write_bytes(read_scan(session, shot).xyz_mm.tobytes())
            (working / RESULT_FILE).write_text(LIGHT_RESULT.replace("DIGEST", session.digest), encoding="utf-8")
            commit(working, result_folder(order.out, order.job.name))
    except Exception as error:
        return Outcome(0.0, f"here:{os.getpid()}", failure=failure_of(error))
    return Outcome(0.02, f"here:{os.getpid()}", facts={"verdict": None, "marks": []})
