"""A mission's known scale, the poses of photos that wait for a tie, the last check in the mosaic."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0004"
down_revision = "0003"
branch_labels = None
depends_on = None

_COLUMNS = (("missions", "scale"), ("frames", "island"), ("surveys", "measured"))


def upgrade() -> None:
    """A column for each."""
    for table, name in _COLUMNS:
        op.add_column(table, sa.Column(name, sa.JSON(none_as_null=True), nullable=True))


def downgrade() -> None:
    """They are lost; photos that wait are told as rejected, which is what they were before."""
    op.execute("UPDATE frames SET state = 'rejected', reason_code = 'not_placeable' WHERE state = 'waiting'")
    for table, name in _COLUMNS:
        op.drop_column(table, name)
