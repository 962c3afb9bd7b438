"""How large a mission's photos are: it decides how they are put together."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0006"
down_revision = "0005"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Missions that are there get to know it with their next solve."""
    op.add_column("missions", sa.Column("photo_side", sa.Integer(), nullable=True))


def downgrade() -> None:
    """The next solve of newer code finds it out again."""
    op.drop_column("missions", "photo_side")
