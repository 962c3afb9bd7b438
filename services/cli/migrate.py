"""`orthostream migrate`: the schema of a database that is not the embedded one."""

from __future__ import annotations

import typer

from services.database import Database
from services.settings import get_settings


def migrate() -> None:
    """Bring the database that ORTHOSTREAM_DATABASE_URL names to the newest schema."""
    database = Database(get_settings().database_url)
    database.upgrade()
    database.close()
    typer.echo("The database has the newest schema.")
