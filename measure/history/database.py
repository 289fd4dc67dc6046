"""Where a history lives and how it is opened: a SQLite file, or PostgreSQL by a URL.

SQLite keeps its rollback journal and full synchronisation, so that a process that is killed leaves the last whole state;
writers take the lock when they begin and wait for each other. PostgreSQL does as much by itself.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from drivers.errors import FileError, SettingsError
from measure.history.tables import HEAD, tables

if TYPE_CHECKING:
    from sqlalchemy import Connection, Engine

FILE_NAME = "history.sqlite"
ENVIRONMENT = "SPHERECAL_HISTORY"
_WAIT_S = 30.0
_LOCK = 7306513
"""Of PostgreSQL's advisory locks: one process at a time makes or changes tables."""
_BEGIN = {True: "BEGIN IMMEDIATE", False: "BEGIN"}


class Database:
    """An open history; a context manager."""

    def __init__(self, engine: Engine, name: str) -> None:
        self._engine = engine
        self.name = name
        """For messages, passwords left out."""

    def __enter__(self) -> Database:
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()

    def close(self) -> None:
        """Let go of it; more than once is fine."""
        self._engine.dispose()

    @contextmanager
    def reading(self) -> Iterator[Connection]:
        """A transaction that changes nothing.

        Raises:
            FileError: the database does not answer, or is none.
        """
        with self._told(), self._engine.connect() as connection, connection.begin():
            yield connection

    @contextmanager
    def writing(self) -> Iterator[Connection]:
        """A transaction that is written as a whole or not at all, one writer after the other; raises as `reading`."""
        with self._told(), self._engine.connect().execution_options(spherecal_write=True) as connection, connection.begin():
            yield connection

    @contextmanager
    def _told(self) -> Iterator[None]:
        from sqlalchemy.exc import DBAPIError

        try:
            yield
        except DBAPIError as error:
            raise _as_ours(error, self.name) from error


def is_url(place: str) -> bool:
    """Whether a place is a URL and no path."""
    return "://" in place


def exists(place: str) -> bool:
    """Whether something is there to be opened; of a URL only opening tells."""
    return is_url(place) or Path(place).is_file()


def open_database(place: str) -> Database:
    """Open a history, made or brought up to date where need be.

    Args:
        place: a path of a SQLite file, or a URL (`sqlite:///...`, `postgresql://...`).

    Raises:
        SettingsError: a URL that says nothing, or a database whose client library is not installed.
        FileError: no such folder, not a history, one of a newer version, or nobody answers.
    """
    engine, name = _engine_of(place)
    database = Database(engine, name)
    try:
        _bring_up_to_date(database)
    except BaseException:
        database.close()
        raise
    return database


def _engine_of(place: str) -> tuple[Engine, str]:
    from sqlalchemy import URL, NullPool, create_engine, event, make_url
    from sqlalchemy.exc import ArgumentError, NoSuchModuleError

    try:
        url = make_url(place) if is_url(place) else URL.create("sqlite", database=str(Path(place).absolute()))
        if url.drivername in {"postgresql", "postgres"}:
            url = url.set(drivername="postgresql+psycopg")
        name = url.render_as_string(hide_password=True) if is_url(place) else place
        if url.get_backend_name() != "sqlite":
            return create_engine(url, poolclass=NullPool), name
        if url.database and not Path(url.database).absolute().parent.is_dir():
            raise FileError("no such folder", file=str(Path(url.database).parent), remedy="Make it, or name another place for the history.")
        engine = create_engine(url, poolclass=NullPool, connect_args={"timeout": _WAIT_S})
    except (ArgumentError, NoSuchModuleError) as error:
        remedy = "Give a path, or a URL such as postgresql://user@host/database."
        raise SettingsError(f"{place.split('://', maxsplit=1)[0]}://...: is no place for a history", where="--history", remedy=remedy) from error
    except ImportError as error:
        remedy = "pip install 'spherecal[postgres]'"
        raise SettingsError(f"the client library of this database is not installed ({error.name})", where="--history", remedy=remedy) from error

    # Python's sqlite3 begins transactions at its own moments; here they begin when SQLAlchemy says so
    @event.listens_for(engine, "connect")
    def _no_hidden_transactions(connection: Any, _record: object) -> None:
        connection.isolation_level = None
        connection.execute("PRAGMA foreign_keys = ON")

    @event.listens_for(engine, "begin")
    def _begin(connection: Connection) -> None:
        connection.exec_driver_sql(_BEGIN[bool(connection.get_execution_options().get("spherecal_write"))])

    return engine, name


def _bring_up_to_date(database: Database) -> None:
    with database.reading() as connection:
        version = _version_of(connection)
    if version == HEAD:
        return
    with database.writing() as connection:
        if connection.dialect.name != "sqlite":
            connection.exec_driver_sql(f"SELECT pg_advisory_xact_lock({_LOCK})")
        version = _version_of(connection)
        if version != HEAD:
            _require_ours(connection, version, database.name)
            _upgrade(connection)


def _version_of(connection: Connection) -> str | None:
    from sqlalchemy import inspect, select

    version = tables().version
    if not inspect(connection).has_table(version.name):
        return None
    return connection.execute(select(version.c.version_num)).scalar()


def _require_ours(connection: Connection, version: str | None, name: str) -> None:
    from sqlalchemy import inspect

    if version is not None and version > HEAD:
        remedy = "Use that version of spherecal, or another history."
        raise FileError(f"was written by a newer spherecal (version {version} of its tables, this one knows {HEAD})", file=name, remedy=remedy)
    if version is None and (found := inspect(connection).get_table_names()) and {"calibration", "result", "activation"} & set(found):
        raise FileError("holds tables of the same names that are no history", file=name, remedy="Name another place for the history.")


def _upgrade(connection: Connection) -> None:
    from alembic import command
    from alembic.config import Config

    config = Config()
    config.set_main_option("script_location", str(Path(__file__).parent / "migrations").replace("%", "%%"))
    config.set_main_option("path_separator", "os")
    config.attributes["connection"] = connection
    command.upgrade(config, "head")


def _as_ours(error: Any, name: str) -> FileError:
    found = " ".join(str(error.orig).split())
    if "locked" in found:
        return FileError(
            f"another program has been writing for {_WAIT_S:.0f} s", file=name, remedy="Try again; if it lasts, see which program holds it."
        )
    if "not a database" in found:
        return FileError("is no database", file=name, remedy="Name another file for the history.")
    if "readonly" in found or "read-only" in found or "unable to open" in found:
        return FileError(f"cannot be written ({found})", file=name, remedy="See the permissions of the file and of its folder.")
    remedy = "See that the database runs, and that its URL, user and rights are right."
    return FileError(f"the database says: {found}", file=name, remedy=remedy)
