"""The submaps of a mission, as of its last solve."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """A column for them; missions that were solved before show none until they are solved again."""
    op.add_column("missions", sa.Column("submaps", sa.JSON(none_as_null=True), nullable=True))


def downgrade() -> None:
    """They are lost."""
    op.drop_column("missions", "submaps")
