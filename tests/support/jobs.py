"""Many small parts for the tests of jobs, some of them spoiled, and work that misbehaves on order."""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from drivers.files.disk import sha256_hex
from drivers.files.ply import encode_ply
from drivers.files.yaml import dump_yaml, load_yaml
from measure.jobs.model import Failure, Order, Outcome
from measure.jobs.work import measure_part
from tests.support.recorded import nominal_calibration, record_session, write_cell

CAMERA = "CAM-1"


@dataclass(frozen=True)
class Parts:
    """A folder of parts, and what is to be expected of them."""

    folder: Path
    calibration: Path
    good: tuple[str, ...]
    spoiled: dict[str, str]
    """Name of the part: how it was spoiled."""


def make_parts(folder: Path, n_parts: int, n_spoiled: int, seed: int) -> Parts:
    """Parts of two small scans each; the spoiled ones are spread at random and take turns in the kinds of damage."""
    rng = np.random.default_rng(seed)
    cell = write_cell(folder)
    first = record_session(folder / "first", cell, rng, shots_per_sphere=2)
    calibration = replace(nominal_calibration(cell, [first]), identity={"camera_serial": CAMERA})
    calibration.save(folder / "calibration.yaml")
    damaged = rng.choice(n_parts, n_spoiled, replace=False)
    kinds = {int(place): list(DAMAGE)[i % len(DAMAGE)] for i, place in enumerate(damaged)}
    good, spoiled = [], {}
    for i in range(n_parts):
        name = f"part{i:04d}"
        session = folder / "parts" / name
        record_session(session, cell, rng, shots_per_sphere=1, n_points=200, purpose="workpiece")
        edit_head(session, {"camera_serial": CAMERA})
        if i in kinds:
            DAMAGE[kinds[i]](session)
            spoiled[name] = kinds[i]
        else:
            good.append(name)
    return Parts(folder / "parts", folder / "calibration.yaml", tuple(good), spoiled)


def edit_head(session: Path, identity: dict[str, str]) -> None:
    head = load_yaml(session / "session.yaml")
    assert isinstance(head, dict)
    (session / "session.yaml").write_text(dump_yaml({**head, "identity": identity}), encoding="utf-8")


def read_lines(session: Path) -> list[dict[str, object]]:
    return [json.loads(line) for line in (session / "shots.jsonl").read_text(encoding="utf-8").splitlines()]


def write_lines(session: Path, lines: Sequence[dict[str, object]]) -> None:
    (session / "shots.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines), encoding="utf-8")


def truncate_scan(session: Path) -> None:
    scan = session / "scans" / "0000.ply"
    scan.write_bytes(scan.read_bytes()[:-500])


def only_nan(session: Path) -> None:
    data = encode_ply(np.full((200, 3), np.nan, dtype=np.float32), comments=("unit mm",))
    lines = read_lines(session)
    for line in lines:
        (session / str(line["scan"])).write_bytes(data)
    write_lines(session, [{**line, "sha256": sha256_hex(data)} for line in lines])


def without_joints(session: Path) -> None:
    write_lines(session, [{**line, "joints_rad": None} for line in read_lines(session)])


def break_line(session: Path) -> None:
    first, *others = (session / "shots.jsonl").read_text(encoding="utf-8").splitlines()
    (session / "shots.jsonl").write_text("\n".join([first[: len(first) // 2], *others, ""]), encoding="utf-8")


def other_camera(session: Path) -> None:
    edit_head(session, {"camera_serial": "CAM-2"})


def no_shots(session: Path) -> None:
    (session / "shots.jsonl").write_bytes(b"")


DAMAGE: dict[str, Callable[[Path], None]] = {
    "truncated scan": truncate_scan,
    "only NaN": only_nan,
    "no joints": without_joints,
    "broken line": break_line,
    "other camera": other_camera,
    "no shots": no_shots,
}


def measure_slowly(order: Order) -> Outcome:
    """The real work, with time to be killed in."""
    time.sleep(0.05)
    return measure_part(order)


def moody(order: Order) -> Outcome:
    """Does what the part's name asks for; a file in OUT counts its attempts."""
    count = order.out / f"attempts-{order.job.part}"
    with count.open("a", encoding="utf-8") as stream:
        stream.write(f"{order.attempt}\n")
    n_attempts = len(count.read_text(encoding="utf-8").splitlines())
    word = order.job.part.split("-")[0]
    if word == "dies" or (word == "dies_once" and n_attempts == 1):
        os.kill(os.getpid(), signal.SIGKILL)
    if word == "hangs_once" and n_attempts == 1:
        time.sleep(60)
    if word == "passes" and n_attempts < 3:
        return Outcome(0.0, "here", failure=Failure("disk or network", "the share is gone", transient=True))
    if word == "fails":
        return Outcome(0.0, "here", failure=Failure("disk or network", "the share is gone", transient=True))
    return measure_part(order)
