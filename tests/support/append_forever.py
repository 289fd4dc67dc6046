"""A run that appends shots until it is killed; prints every index after the append has returned."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from acquire.session import SessionWriter


def main(folder: Path) -> None:
    rng = np.random.default_rng(1)
    with SessionWriter.resume(folder) as writer:
        sys.stdout.write("ready\n")
        sys.stdout.flush()
        while True:
            cloud = rng.normal(size=(2000, 3)).astype(np.float32)
            shot = writer.append(sphere="A", base_from_flange=np.eye(4), xyz_mm=cloud, frames_xyz_mm=[cloud])
            sys.stdout.write(f"{shot.index}\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
