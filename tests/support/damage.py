"""What people, disks and scripts do to a good session: each function spoils a copy of one in one way."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drivers.files.ply import read_ply, write_ply

SHOT = 1
"""The line of shots.jsonl that is spoilt, from 0."""


@dataclass(frozen=True, slots=True)
class Damage:
    """One kind of bad input, and what the one line about it must name."""

    spoil: Callable[[Path], None]
    file: str
    """End of the file's name in the message."""
    where: str
    """A place in it; empty where the whole file is the place."""
    words: tuple[str, ...]
    """One of these must be in the line, in lower case."""


def edit_line(session: Path, change: Callable[[dict[str, Any]], None], line: int = SHOT) -> None:
    """Change one line of shots.jsonl."""
    path = session / "shots.jsonl"
    lines = path.read_text(encoding="utf-8").splitlines()
    shot = json.loads(lines[line])
    change(shot)
    lines[line] = json.dumps(shot)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def scan_of(session: Path, line: int = SHOT) -> Path:
    """The scan of a line of shots.jsonl."""
    shot = json.loads((session / "shots.jsonl").read_text(encoding="utf-8").splitlines()[line])
    return session / str(shot["scan"])


def edit_cell(session: Path, change: Callable[[str], str]) -> None:
    """Change the session's copy of the cell file."""
    path = session / "cell.yaml"
    text = path.read_text(encoding="utf-8")
    changed = change(text)
    if changed == text:
        raise LookupError("the cell file holds nothing to spoil")
    path.write_text(changed, encoding="utf-8")


def cut_off_scan(session: Path) -> None:
    scan = scan_of(session)
    scan.write_bytes(scan.read_bytes()[:-100])


def missing_scan(session: Path) -> None:
    scan_of(session).unlink()


def changed_scan(session: Path) -> None:
    data = bytearray(scan_of(session).read_bytes())
    data[-3] ^= 0x40
    scan_of(session).write_bytes(bytes(data))


def nan_joints(session: Path) -> None:
    edit_line(session, lambda shot: shot["joints_rad"].__setitem__(2, math.nan))


def five_joints(session: Path) -> None:
    def cut(shot: dict[str, Any]) -> None:
        shot["joints_rad"].pop()
        shot.pop("target_joints_rad", None)

    for line in range(len((session / "shots.jsonl").read_text(encoding="utf-8").splitlines())):
        edit_line(session, cut, line)


def one_shot_with_five_joints(session: Path) -> None:
    edit_line(session, lambda shot: shot["joints_rad"].pop())


def unknown_sphere(session: Path) -> None:
    edit_line(session, lambda shot: shot.update(sphere="Zebra"))


def unknown_key(session: Path) -> None:
    edit_cell(session, lambda text: text + "\nspehres: {}\n")


def broken_yaml(session: Path) -> None:
    edit_cell(session, lambda text: text + "\n  ]: [\n")


def broken_json(session: Path) -> None:
    path = session / "shots.jsonl"
    lines = path.read_text(encoding="utf-8").splitlines()
    lines[SHOT] = lines[SHOT][:40]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def no_shots(session: Path) -> None:
    (session / "shots.jsonl").write_text("", encoding="utf-8")


def bent_hand_eye(session: Path) -> None:
    import yaml

    path = session / "cell.yaml"
    data = yaml.safe_load(path.read_text(encoding="utf-8"))
    data["flange_from_camera"][0] = [2.0 * x for x in data["flange_from_camera"][0]]
    path.write_text(json.dumps(data), encoding="utf-8")


def metres(session: Path) -> None:
    """All scans in metres, with digests that are right: a camera that was set wrongly."""
    count = len((session / "shots.jsonl").read_text(encoding="utf-8").splitlines())
    for line in range(count):
        scan = scan_of(session, line)
        cloud = read_ply(scan)
        write_ply(scan, np.asarray(cloud.xyz_mm * np.float32(1e-3)), comments=cloud.comments)
        digest = hashlib.sha256(scan.read_bytes()).hexdigest()
        edit_line(session, lambda shot, digest=digest: shot.update(sha256=digest), line)  # type: ignore[misc]


def degrees(session: Path) -> None:
    """All axis angles in degrees: an importer that was written wrongly."""
    count = len((session / "shots.jsonl").read_text(encoding="utf-8").splitlines())
    for line in range(count):
        edit_line(session, lambda shot: shot.update(joints_rad=np.degrees(shot["joints_rad"]).tolist()), line)


DAMAGES: Mapping[str, Damage] = {
    "cut-off PLY": Damage(cut_off_scan, ".ply", "", ("cut off", "too short", "ends")),
    "missing scan": Damage(missing_scan, "shots.jsonl", "line 2", ("missing",)),
    "wrong digest": Damage(changed_scan, ".ply", "", ("sha256",)),
    "NaN joints": Damage(nan_joints, "shots.jsonl", "line 2", ("nan", "finite")),
    "five joints": Damage(five_joints, "shots.jsonl", "", ("5", "five")),
    "one shot with five joints": Damage(one_shot_with_five_joints, "shots.jsonl", "line 2", ("5", "five")),
    "unknown sphere": Damage(unknown_sphere, "shots.jsonl", "line 2", ("zebra",)),
    "unknown key": Damage(unknown_key, "cell.yaml", "spehres", ("spehres",)),
    "broken YAML": Damage(broken_yaml, "cell.yaml", "line", ("yaml", "expected", "found")),
    "broken JSON line": Damage(broken_json, "shots.jsonl", "line 2", ("json",)),
    "empty session": Damage(no_shots, "shots.jsonl", "", ("no shot",)),
    "non-rigid hand-eye": Damage(bent_hand_eye, "cell.yaml", "flange_from_camera", ("rigid",)),
    "scans in metres": Damage(metres, "scans", "", ("metre",)),
    "joints in degrees": Damage(degrees, "shots.jsonl", "", ("degree",)),
}
