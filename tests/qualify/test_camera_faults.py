"""A fake GigE Vision camera that misbehaves at random, over and over: the right error or the right frame, never anything else."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.cameras.genicam import make_camera
from drivers.cameras.genicam.aravis import AravisTransport
from drivers.cameras.genicam.camera import GenicamCamera
from drivers.errors import CameraBusy, CameraError, CameraLost, CameraMisconfigured, CameraNotReached, CameraTimeout, IncompleteFrame
from drivers.registry import DriverContext
from tests.support.fake_gige import ADDRESS, FakeGige, fake_gige
from tests.support.scan_scene import ScanScene

pytestmark = pytest.mark.qualify

ROUNDS = 30
SHORT_S = 0.4
WRONG_FORMATS = ("Mono8", "Mono16", "BayerRG8", "RGB8Packed", "Coord3D_C16")


class World:
    """A camera, and every scene that it has exposed, in order."""

    def __init__(self, fake: FakeGige, scene: ScanScene, rng: np.random.Generator) -> None:
        self.fake, self.scene, self.rng = fake, scene, rng
        self.exposed: list[NDArray[np.float32]] = []
        fake.expose = self.expose

    def expose(self) -> NDArray[np.float32]:
        """The scene as it is now."""
        self.exposed.append(self.scene.expose())
        return self.exposed[-1]

    def good(self, camera: GenicamCamera) -> str:
        """A capture that must work, and be of what was exposed after it was asked for."""
        return self.tried(camera, 5.0, ())

    def tried(self, camera: GenicamCamera, timeout_s: float, allowed: tuple[type[CameraError], ...]) -> str:
        """A capture: `frame`, where it shows an exposure of its own bit for bit, or the name of an allowed error."""
        self.scene.move()
        before = len(self.exposed)
        try:
            found = camera.capture(timeout_s=timeout_s).xyz_mm
        except allowed as error:
            return type(error).__name__ if error.remedy else "an error without a remedy"
        assert any(np.array_equal(found, exposed, equal_nan=True) for exposed in self.exposed[before:]), "a frame of another exposure"
        return "frame"


def camera_of(**settings: object) -> GenicamCamera:
    return make_camera(DriverContext({"address": ADDRESS, **settings}, None, Path()))


def lost_packets(world: World) -> str:
    camera = camera_of()
    camera.open()
    world.good(camera)
    world.fake.lose(float(world.rng.choice([0.003, 0.02, 0.2, 1.0])))
    result = world.tried(camera, SHORT_S, (IncompleteFrame, CameraTimeout))
    world.fake.lose(0.0)
    world.good(camera)
    camera.close()
    return result


def dead_camera(world: World) -> str:
    camera = camera_of()
    camera.open()
    world.good(camera)
    timer = threading.Timer(float(world.rng.uniform(0, 0.1)), world.fake.stop)
    timer.start()
    results = [world.tried(camera, SHORT_S, (CameraLost, CameraTimeout, IncompleteFrame)) for _ in range(2)]
    timer.join()
    results.append(world.tried(camera, SHORT_S, (CameraLost,)))
    camera.close()
    world.fake.start()
    camera.open()
    world.good(camera)
    camera.close()
    return results[-1]


def second_client(world: World) -> str:
    other, camera = AravisTransport(ADDRESS), camera_of()
    other.open()
    with pytest.raises(CameraBusy):
        camera.open()
    other.close()
    camera.open()
    world.good(camera)
    with pytest.raises(CameraBusy):
        other.open()
    world.good(camera)  # whoever came second has taken nothing
    camera.close()
    return "CameraBusy"


def stale_buffers(world: World) -> str:
    camera = camera_of()
    camera.open()
    world.good(camera)
    if world.rng.random() < 0.5:
        for _ in range(int(world.rng.integers(1, 7))):  # more than there are buffers
            world.fake.trigger()
    else:
        world.fake.delay_s = SHORT_S + float(world.rng.uniform(0.05, 0.3))
        assert world.tried(camera, SHORT_S, (CameraTimeout,)) == "CameraTimeout"
        world.fake.delay_s = 0.0
    result = world.good(camera)
    camera.close()
    return result


def wrong_formats(world: World) -> str:
    camera = camera_of(pixel_format=str(world.rng.choice(WRONG_FORMATS)))
    with pytest.raises(CameraMisconfigured) as caught:
        _open_and_capture(camera)
    assert caught.value.remedy
    camera.close()
    camera = camera_of()
    camera.open()
    world.good(camera)
    camera.close()
    return "CameraMisconfigured"


def nobody_there(world: World) -> str:
    with pytest.raises(CameraNotReached):
        camera_of(address=f"127.0.0.{int(world.rng.integers(80, 250))}").open()
    return "CameraNotReached"


def _open_and_capture(camera: GenicamCamera) -> None:
    camera.open()
    camera.capture(timeout_s=2)


FAULTS: dict[str, tuple[Callable[[World], str], set[str]]] = {
    "packet loss": (lost_packets, {"IncompleteFrame", "CameraTimeout", "frame"}),
    "dead camera": (dead_camera, {"CameraLost"}),
    "second client": (second_client, {"CameraBusy"}),
    "stale buffers": (stale_buffers, {"frame"}),
    "wrong pixel formats": (wrong_formats, {"CameraMisconfigured"}),
    "nobody there": (nobody_there, {"CameraNotReached"}),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_every_fault_ends_in_its_error_and_none_in_a_wrong_frame(fault: str) -> None:
    seed = int(np.random.SeedSequence().generate_state(1)[0]) % 100_000
    scene, (cause, allowed) = ScanScene(), FAULTS[fault]
    with fake_gige(scene.expose) as fake:
        world = World(fake, scene, np.random.default_rng(seed))
        results = Counter(cause(world) for _ in range(ROUNDS if fault != "dead camera" else ROUNDS // 3))
    print(f"{fault}, seed {seed}: {dict(results)}")
    assert set(results) <= allowed
    assert fault != "packet loss" or results["IncompleteFrame"] > 0
