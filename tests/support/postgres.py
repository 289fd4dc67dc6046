"""A PostgreSQL server of the system's packages: own data folder, loopback only, own port, gone with its block."""

from __future__ import annotations

import importlib.util
import os
import pwd
import shutil
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_PLACES = ("/usr/lib/postgresql",)
_STARTED_WITHIN_S = 30.0


def server_folder() -> Path | None:
    """Where `initdb` and `postgres` are, or None."""
    found = sorted(path.parent for place in _PLACES for path in Path(place).glob("*/bin/initdb"))
    on_path = shutil.which("initdb")
    return found[-1] if found else None if on_path is None else Path(on_path).parent


def why_not() -> str | None:
    """What is missing for a test against PostgreSQL, or None."""
    if server_folder() is None:
        return "no PostgreSQL server here (Debian: apt-get install postgresql)"
    if importlib.util.find_spec("psycopg") is None:
        return "no psycopg here (pip install 'spherecal[postgres]')"
    if os.geteuid() == 0 and not _has_user("postgres"):
        return "PostgreSQL does not run as root, and there is no user postgres"
    return None


@contextmanager
def postgres_url() -> Iterator[str]:
    """Run a server; gives the URL of an empty database."""
    bins = server_folder()
    assert bins is not None
    user = "postgres" if os.geteuid() == 0 else None
    folder = Path(tempfile.mkdtemp(prefix="spherecal-pg-"))
    if user is not None:
        shutil.chown(folder, user)
    data, port = folder / "data", _free_port()
    # the server's own programs must not depend on where the tests run or on whose behalf
    environment = {"PATH": os.environ["PATH"], "LC_ALL": "C", "HOME": str(folder)}
    try:
        made = [str(bins / "initdb"), "-D", str(data), "-U", "spherecal", "-A", "trust", "--no-sync", "-E", "UTF8"]
        subprocess.run(made, cwd=folder, user=user, env=environment, check=True, capture_output=True, timeout=120)
        options = ["-c", "listen_addresses=127.0.0.1", "-c", f"port={port}", "-c", f"unix_socket_directories={folder}", "-c", "fsync=off"]
        server = subprocess.Popen(
            [str(bins / "postgres"), "-D", str(data), *options], cwd=folder, user=user, env=environment, stderr=subprocess.DEVNULL
        )
        try:
            _wait_for(port, server)
            yield f"postgresql://spherecal@127.0.0.1:{port}/postgres"
        finally:
            server.terminate()
            server.wait(timeout=60)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _has_user(name: str) -> bool:
    return any(entry.pw_name == name for entry in pwd.getpwall())


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _wait_for(port: int, server: subprocess.Popen[bytes]) -> None:
    import psycopg

    end = time.monotonic() + _STARTED_WITHIN_S
    while True:
        try:
            psycopg.connect(f"host=127.0.0.1 port={port} user=spherecal dbname=postgres", connect_timeout=5).close()
        except psycopg.OperationalError:
            if server.poll() is not None or time.monotonic() > end:
                raise
            time.sleep(0.1)
        else:
            return
