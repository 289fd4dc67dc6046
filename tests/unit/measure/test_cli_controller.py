"""`simulate-controller`: what it refuses, and that it ends when it is told to."""

from __future__ import annotations

import json
import signal
import socket
from pathlib import Path

import pytest

from drivers.models import load_robot_model, robot_model_data
from measure.cli import app
from measure.cli_run import run_app
from tests.support.fake_ur import fake_ur, own_address


@pytest.mark.parametrize(
    ("options", "word"),
    [
        (["--host", "192.168.0.1"], "loopback"),
        (["--host", "0.0.0.0"], "loopback"),
        (["--model", "abb_irb1410"], "no UR"),
        (["--model", "no_such_model"], "no robot model"),
        (["--truth", "no_such_file.yaml"], "no_such_file"),
        (["--cell", "no_such_cell.yaml"], "no_such_cell"),
        (["--host", own_address(8), "--bench-port", "0", "--fault", "nonsense"], "black_hole"),
        (["--host", own_address(8), "--bench-port", "0", "--fault", "slow x"], "--fault"),
    ],
)
def test_what_cannot_be_served(options: list[str], word: str, capfd: pytest.CaptureFixture[str]) -> None:
    assert run_app(app, ["simulate-controller", "ur", *options, "--json"]) == 1
    error = json.loads(capfd.readouterr().out)["error"]
    assert word in " ".join(str(part) for part in error.values())
    assert error["remedy"]


def test_a_taken_port_is_told(capfd: pytest.CaptureFixture[str]) -> None:
    host = own_address(8)
    with socket.create_server((host, 29999)):
        assert run_app(app, ["simulate-controller", "ur", "--host", host, "--bench-port", "0", "--json"]) == 1
    assert "29999" in json.loads(capfd.readouterr().out)["error"]["message"]


def test_it_misbehaves_from_the_start_and_ends_when_told(tmp_path: Path) -> None:
    model = tmp_path / "long_arm.yaml"
    model.write_text(json.dumps(robot_model_data(load_robot_model("ur10e"))), encoding="utf-8")
    with fake_ur(own_address(9), "--model", str(model), "--fault", "safeguard_stop", "--fault", "local") as running:
        assert "SAFEGUARD" in _dashboard(running.host, "safetystatus")  # from the start, and not soon after it
        assert _dashboard(running.host, "get robot model") == "UR10"
        assert _dashboard(running.host, "is in remote control") == "false"
        running.process.send_signal(signal.SIGTERM)
        assert running.process.wait(5) == 0
    with pytest.raises(OSError, match="refused"):
        socket.create_connection((own_address(9), 29999), 1)


def _dashboard(host: str, question: str) -> str:
    from drivers.ur.dashboard import ask
    from drivers.ur.net import Deadline

    return ask(host, question, deadline=Deadline.after(2))[0]
