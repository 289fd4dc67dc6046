"""Print the Debian packages whose shared libraries cannot be loaded here, on one line.

Run by tools/environment.sh before the environment exists, so only the standard library is used.
Open3D needs the first four, numba's OpenMP threads the last.
"""

import ctypes

PACKAGE_OF_LIBRARY = {
    "libEGL.so.1": "libegl1",
    "libGL.so.1": "libgl1",
    "libX11.so.6": "libx11-6",
    "libusb-1.0.so.0": "libusb-1.0-0",
    "libgomp.so.1": "libgomp1",
}


def loads(library: str) -> bool:
    """Whether the dynamic loader finds the library."""
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


if __name__ == "__main__":
    print(*(package for library, package in PACKAGE_OF_LIBRARY.items() if not loads(library)))  # noqa: T201
