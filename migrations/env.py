"""Where alembic starts: runs the revisions on the connection it was handed, in its caller's transaction."""

from __future__ import annotations

from alembic import context

from services.tables import Base

connection = context.config.attributes["connection"]
context.configure(
    connection=connection,
    target_metadata=Base.metadata,
    compare_type=True,
    render_as_batch=connection.dialect.name == "sqlite",
)
# No begin_transaction(): alembic thinks that SQLite cannot roll back a CREATE TABLE, and we know that it can.
context.run_migrations()
