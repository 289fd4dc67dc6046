"""`spherecal teach`: keys on a real terminal line, and a plan that is on disk after every pose."""

from __future__ import annotations

import io
import json
import os
import pty
import signal
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from acquire.cell import load_cell, robot_model_of
from acquire.plan import load_plan
from acquire.teach import TeachSettings, run_teach
from acquire.teach_events import Finish, Guide, Jog, Looked, NextSphere, Record, TeachCommand, Undo, Via
from measure.cli import app
from measure.cli_run import run_app
from measure.demo_cell import write_demo_cell
from measure.teaching import Hand, TeachScreen, teach
from tests.support.fake_devices import fake_cell, fake_devices


@pytest.fixture(scope="module")
def cell_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_demo_cell(tmp_path_factory.mktemp("cell"), 7, (120, 75))


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """The hand's end of a terminal whose other end is stdin."""
    ours, theirs = pty.openpty()
    with os.fdopen(theirs, "r", encoding="utf-8") as stdin:
        monkeypatch.setattr(sys, "stdin", stdin)
        yield ours
    os.close(ours)


def run(terminal: int, keys: str, *arguments: object, capfd: Any) -> tuple[int, dict[str, Any], str]:
    os.write(terminal, keys.encode())
    code = run_app(app, ["teach", *map(str, arguments), "--every", "0.05", "--json"])
    out, err = capfd.readouterr()
    assert out.count("\n") == 1
    return code, json.loads(out), err


def test_a_taught_plan_loads_and_holds_what_was_kept(cell_file: Path, terminal: int, tmp_path: Path, capfd: Any) -> None:
    out = tmp_path / "plan.yaml"
    # refused (no sphere at home), kept unseen, jogged on the way, kept, and one more taken back
    keys = "\n" + "f" + "5+v" + "2-" + "f" + "f" + "u" + "q"
    code, told, err = run(terminal, keys, cell_file, "-o", out, "--jog", "--for", "verify", "--sphere", "A", capfd=capfd)
    assert (code, told["n_poses"], told["spheres"], told["state"], told["out"]) == (0, 2, {"A": 2}, "complete", str(out))
    cell = load_cell(cell_file)
    plan = load_plan(out, cell, robot_model_of(cell))
    assert (plan.purpose, plan.cell_sha256) == ("verification", cell.sha256)
    np.testing.assert_allclose(np.degrees(plan.poses[1].joints_rad), [0, -2, 0, 0, 2, 0], atol=1e-3)
    np.testing.assert_allclose(np.degrees(plan.poses[1].via_rad), [[0, 0, 0, 0, 2, 0]], atol=1e-3)
    for part in ("sphere A NOT seen", "not kept:", "pose t001 kept", "axis 5 at 2.00 degrees", "pose t003 is forgotten"):
        assert part in err
    assert max(map(len, err.splitlines())) < 200


def test_an_interrupt_keeps_what_was_taught(cell_file: Path, terminal: int, tmp_path: Path, capfd: Any) -> None:
    out, ended = tmp_path / "plan.yaml", threading.Event()

    def press() -> None:
        # as the terminal does it, once the first pose is on disk; Python loses an interrupt that falls into a finaliser
        for _ in range(600):
            if out.exists():
                break
            time.sleep(0.05)
        while not ended.wait(0.2):
            os.kill(os.getpid(), signal.SIGINT)
            ended.wait(3.0)

    presser = threading.Thread(target=press)
    presser.start()
    try:
        code, told, _ = run(terminal, "f", cell_file, "-o", out, "--jog", capfd=capfd)
    finally:
        ended.set()
        presser.join()
    assert (code, told["n_poses"], told["state"]) == (130, 1, "interrupted")
    assert len(load_plan(out).poses) == 1


def test_without_a_pose_the_earlier_plan_stays(cell_file: Path, terminal: int, tmp_path: Path, capfd: Any) -> None:
    out = tmp_path / "plan.yaml"
    assert run(terminal, "fq", cell_file, "-o", out, "--jog", capfd=capfd)[0] == 0
    before = out.read_bytes()
    code, told, _ = run(terminal, "fuq", cell_file, "-o", out, "--jog", capfd=capfd)
    assert (code, told["error"]["message"]) == (1, "no pose was kept, and so no plan was written")
    assert [path.name for path in tmp_path.iterdir()] == ["plan.yaml"]
    assert out.read_bytes() == before
    code, _, err = run(terminal, "5+fq", cell_file, "-o", out, "--jog", capfd=capfd)
    assert code == 0
    assert "was kept as" in err
    assert len(list(tmp_path.iterdir())) == 2


def test_a_terminal_is_needed(cell_file: Path, tmp_path: Path, capfd: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    with (tmp_path / "empty").open("w+", encoding="utf-8") as stdin:
        monkeypatch.setattr(sys, "stdin", stdin)
        assert run_app(app, ["teach", str(cell_file), "-o", str(tmp_path / "plan.yaml")]) == 1
    assert "there is no terminal" in capfd.readouterr().err


@pytest.mark.parametrize(("answer", "code"), [("move", 0), ("yes", 1)])
def test_a_robot_that_may_hurt_is_not_moved_unasked(
    answer: str, code: int, cell_file: Path, terminal: int, tmp_path: Path, capfd: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("measure.running.moves_a_real_robot", lambda _: True)
    found, _, err = run(terminal, f"{answer}\nfq", cell_file, "-o", tmp_path / "plan.yaml", "--jog", capfd=capfd)
    assert found == code
    assert "will move one axis at a key press" in err


LOOKED = Looked(np.zeros(6), "A", None, "no_sphere", True, None, (), 0)


@pytest.mark.parametrize(
    ("key", "command"),
    [
        ("\n", Record()),
        ("\r", Record()),
        ("f", Record(anyway=True)),
        ("v", Via()),
        ("u", Undo()),
        ("n", NextSphere()),
        ("g", Guide(on=False)),
        ("q", Finish()),
        ("x", None),
        ("\x1b", None),
    ],
)
def test_keys(key: str, command: TeachCommand | None) -> None:
    assert Hand(jog=False).command(key, LOOKED) == command
    assert Hand(jog=True).command(key, LOOKED) == command


def test_keys_of_jogging_do_nothing_unless_asked_for() -> None:
    silent, hand = Hand(jog=False), Hand(jog=True)
    assert [silent.command(key, LOOKED) for key in "5+-<>"] == [None] * 5
    assert hand.command("+", LOOKED) == Jog(0, float(np.radians(2)))
    assert [hand.command(key, LOOKED) for key in "3<"] == [None, None]
    assert hand.command("-", LOOKED) == Jog(2, float(-np.radians(1)))
    for _ in range(20):
        hand.command(">", LOOKED)
    assert hand.command("+", LOOKED) == Jog(2, float(np.radians(20)))


class Script:
    """Keys pressed one after the other."""

    def __init__(self, keys: str) -> None:
        self.keys = list(keys)

    def pressed(self, wait_s: float = 0.0) -> str | None:
        del wait_s
        return self.keys.pop(0) if self.keys else "q"


def test_the_picture_fits_a_small_terminal(tmp_path: Path) -> None:
    from rich.console import Console

    cell = fake_cell(tmp_path)
    devices, _, _ = fake_devices()
    pictures: list[str] = []
    console = Console(width=80, record=True, file=io.StringIO())

    def draw(shown: Any) -> None:
        console.print(shown)
        pictures.append(console.export_text())

    hand = Hand(jog=True)
    saved: list[int] = []
    lesson = run_teach(devices, cell, TeachSettings(guided=False))
    teach(lesson, Script("\n1+\nv+\nq"), TeachScreen(lambda _: None, draw, hand), hand, lambda poses: saved.append(len(poses)), every_s=0.0)
    assert saved == [1, 2, 3]
    assert max(len(line) for text in pictures for line in text.splitlines()) <= 80
    assert max(len(text.splitlines()) for text in pictures) <= 24
    last = pictures[-1]
    for part in ("3 poses: 3 of A", "sphere A seen: ", "mm away", "via 1", "NO safety function", "held", "jog: axis 1, step 2 degrees"):
        assert part in last
