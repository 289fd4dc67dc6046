"""The first tables: calibrations, results, activations, rules; rows are written once and never changed."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None

_TABLES = ("calibration", "result", "activation", "rule")


def upgrade() -> None:
    """Make the tables, and triggers that refuse changes and deletions."""
    op.create_table(
        "calibration",
        sa.Column("id", sa.String(64), primary_key=True),
        sa.Column("cell", sa.Text, nullable=False, index=True),
        sa.Column("recorded_utc", sa.String(32), nullable=False),
        sa.Column("created_utc", sa.String(32), nullable=False),
        sa.Column("verdict", sa.String(16), nullable=False),
        sa.Column("parent", sa.String(64)),
        sa.Column("file", sa.Text, nullable=False),
        sa.Column("yaml", sa.Text, nullable=False),
    )
    op.create_table(
        "result",
        sa.Column("number", sa.Integer, primary_key=True, autoincrement=True),
        sa.Column("digest", sa.String(64), nullable=False, unique=True),
        sa.Column("cell", sa.Text, nullable=False, index=True),
        sa.Column("kind", sa.String(16), nullable=False),
        sa.Column("calibration", sa.String(64), nullable=False, index=True),
        sa.Column("recorded_utc", sa.String(32), nullable=False),
        sa.Column("taken_utc", sa.String(32), nullable=False),
        sa.Column("verdict", sa.String(16), nullable=False),
        sa.Column("software", sa.Text, nullable=False),
        sa.Column("content", sa.Text, nullable=False),
    )
    op.create_table(
        "activation",
        sa.Column("number", sa.Integer, primary_key=True, autoincrement=True),
        sa.Column("cell", sa.Text, nullable=False, index=True),
        sa.Column("calibration", sa.String(64), sa.ForeignKey("calibration.id"), nullable=False),
        sa.Column("at_utc", sa.String(32), nullable=False),
        sa.Column("who", sa.Text, nullable=False),
        sa.Column("why", sa.Text, nullable=False),
        sa.Column("forced", sa.Boolean, nullable=False),
    )
    op.create_table(
        "rule",
        sa.Column("number", sa.Integer, primary_key=True, autoincrement=True),
        sa.Column("cell", sa.Text, nullable=False, index=True),
        sa.Column("at_utc", sa.String(32), nullable=False),
        sa.Column("who", sa.Text, nullable=False),
        sa.Column("check_every_h", sa.Float),
    )
    for table in _TABLES:
        _written_once(table)


def _written_once(table: str) -> None:
    if op.get_context().dialect.name == "sqlite":
        for event in ("UPDATE", "DELETE"):
            message = f"rows of {table} are never changed or deleted"
            op.execute(f"CREATE TRIGGER {table}_no_{event.lower()} BEFORE {event} ON {table} BEGIN SELECT RAISE(ABORT, '{message}'); END")
        return
    op.execute(
        f"CREATE FUNCTION {table}_written_once() RETURNS trigger LANGUAGE plpgsql AS $$ "
        f"BEGIN RAISE EXCEPTION 'rows of {table} are never changed or deleted'; END $$"
    )
    op.execute(
        f"CREATE TRIGGER {table}_written_once BEFORE UPDATE OR DELETE OR TRUNCATE ON {table} "
        f"FOR EACH STATEMENT EXECUTE FUNCTION {table}_written_once()"
    )
