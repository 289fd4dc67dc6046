"""The tables as SQLAlchemy knows them; how they came about is in `migrations/`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sqlalchemy import Table

HEAD = "0001"
"""Version of the tables that this program writes."""


@dataclass(frozen=True, slots=True)
class Tables:
    """All of them."""

    calibration: Table
    result: Table
    activation: Table
    rule: Table
    version: Table


@lru_cache(maxsize=1)
def tables() -> Tables:
    """The tables, made when they are first needed: importing SQLAlchemy takes a third of a second."""
    from sqlalchemy import Boolean, Column, Float, Integer, MetaData, String, Table, Text

    every = MetaData()
    return Tables(
        calibration=Table(
            "calibration",
            every,
            Column("id", String(64), primary_key=True),
            *(Column(name, Text) for name in ("cell", "recorded_utc", "created_utc", "verdict", "parent", "file", "yaml")),
        ),
        result=Table(
            "result",
            every,
            Column("number", Integer, primary_key=True),
            *(
                Column(name, Text)
                for name in ("digest", "cell", "kind", "calibration", "recorded_utc", "taken_utc", "verdict", "software", "content")
            ),
        ),
        activation=Table(
            "activation",
            every,
            Column("number", Integer, primary_key=True),
            *(Column(name, Text) for name in ("cell", "calibration", "at_utc", "who", "why")),
            Column("forced", Boolean),
        ),
        rule=Table(
            "rule",
            every,
            Column("number", Integer, primary_key=True),
            *(Column(name, Text) for name in ("cell", "at_utc", "who")),
            Column("check_every_h", Float),
        ),
        version=Table("alembic_version", every, Column("version_num", String(32), primary_key=True)),
    )
