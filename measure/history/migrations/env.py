"""What alembic runs: the connection is handed over by `measure.history.database`, which also holds the lock."""

from __future__ import annotations

from alembic import context

# there is a configuration only while alembic runs this
_config = getattr(context, "config", None)
if _config is not None:
    context.configure(connection=_config.attributes["connection"], transaction_per_migration=False, transactional_ddl=False)
    context.run_migrations()
