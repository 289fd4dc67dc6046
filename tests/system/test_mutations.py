"""Files spoilt at random never end in a bug report: every command does its work or tells one line and exits 1."""

from __future__ import annotations

import hashlib
import json
import random
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.system.conftest import Cli, SmallCell

N_SHOTS = 3
TOKENS = (
    *(b"nan", b"null", b"-1", b"1e999", b"[]", b"{}", b'"x"', b"true", b"\x00", b"\xff", b": ", b"\n", b"1e300", b"0", b".inf", b"~"),
    *(b"!!python/object:os.system", b"&a", b"*a", b"99999999999999999999", "é".encode()),
)


def mutated(data: bytes, rng: random.Random) -> bytes:
    """Bytes with one to five things cut, inserted, flipped or replaced."""
    found = bytearray(data)
    for _ in range(rng.choice([1, 1, 2, 5])):
        i = rng.randrange(len(found) + 1)
        match rng.randrange(4):
            case 0:
                del found[i : i + rng.randrange(1, 12)]
            case 1:
                found[i : i + rng.randrange(6)] = rng.choice(TOKENS)
            case 2 if i < len(found):
                found[i] = rng.randrange(256)
            case _:
                words = list(re.finditer(rb"[-\d.e]+|\w+", bytes(found)))
                if words:
                    word = rng.choice(words)
                    found[word.start() : word.end()] = rng.choice(TOKENS)
    return bytes(found)


@pytest.fixture
def short_session(small: SmallCell, tmp_path: Path) -> Path:
    """Three shots of the verification session."""
    session = tmp_path / "session"
    (session / "scans").mkdir(parents=True)
    for name in ("cell.yaml", "session.yaml", "robot_model.yaml", "plan.yaml"):
        shutil.copy(small.verification_session / name, session)
    lines = (small.verification_session / "shots.jsonl").read_text().splitlines()[:N_SHOTS]
    (session / "shots.jsonl").write_text("\n".join(lines) + "\n")
    for line in lines:
        shutil.copy(small.verification_session / json.loads(line)["scan"], session / "scans")
    return session


@pytest.fixture
def spoil_and_run(small: SmallCell, calibration: Path, short_session: Path, tmp_path: Path, cli: Cli) -> Callable[[random.Random], None]:
    """Spoil one file at random, run a command that reads it, judge what it says, and mend the file."""
    own_calibration = tmp_path / "calibration.yaml"
    shutil.copy(calibration, own_calibration)
    centres = ["centres", short_session, "-o", tmp_path / "out"]
    stitch = ["stitch", own_calibration, short_session, "-o", tmp_path / "out", "--voxel", 5]
    verify = ["verify", own_calibration, short_session]
    dry_run = ["capture", small.cell, short_session / "plan.yaml", "-o", tmp_path / "never", "--dry-run"]
    doctor = ["doctor", short_session / "cell.yaml", "--offline"]
    choices: list[tuple[Path, list[list[object]]]] = [
        *((short_session / name, [centres, stitch, verify]) for name in ("cell.yaml", "session.yaml", "shots.jsonl", "robot_model.yaml")),
        (short_session / "cell.yaml", [doctor, centres]),
        (short_session / "shots.jsonl", [centres, stitch, verify]),
        (short_session / "scans" / "0000.ply", [centres, stitch]),
        (short_session / "plan.yaml", [dry_run]),
        (own_calibration, [stitch, verify]),
    ]

    def once(rng: random.Random) -> None:
        target, commands = rng.choice(choices)
        whole = {path: path.read_bytes() for path in (target, short_session / "shots.jsonl")}
        if target.suffix == ".ply":
            spoil_header(target, short_session, rng)
        else:
            target.write_bytes(mutated(whole[target], rng))
        command = rng.choice(commands)
        result = cli(*command, "--json")
        assert result.code in (0, 1, 3), (command, result)
        assert "unexpected" not in (result.told.get("error") or {}).get("message", "")[:10], (command, result)
        assert result.code != 1 or result.err.count("\n") == 1, (command, result)
        assert not (tmp_path / "never").exists()
        for path, data in whole.items():
            path.write_bytes(data)

    return once


def spoil_header(scan: Path, session: Path, rng: random.Random) -> None:
    """A scan whose digest is right and whose header is not."""
    data = scan.read_bytes()
    end = data.index(b"end_header") + len(b"end_header\n")
    scan.write_bytes(mutated(data[:end], rng) + data[end:])
    path = session / "shots.jsonl"
    first, *others = path.read_text().splitlines()
    shot = json.loads(first) | {"sha256": hashlib.sha256(scan.read_bytes()).hexdigest()}
    path.write_text("\n".join([json.dumps(shot), *others]) + "\n")


def test_spoilt_files_are_told(spoil_and_run: Callable[[random.Random], None]) -> None:
    rng = random.Random(20231122)
    for _ in range(30):
        spoil_and_run(rng)


@pytest.mark.qualify
def test_many_spoilt_files_are_told(spoil_and_run: Callable[[random.Random], None], capfd: pytest.CaptureFixture[str]) -> None:
    seed = random.SystemRandom().randrange(2**32)
    with capfd.disabled():  # every command empties what was caught, and the seed with it
        print(f"\nqualify spoilt files seed={seed}")
    rng = random.Random(seed)
    for _ in range(2000):
        spoil_and_run(rng)
