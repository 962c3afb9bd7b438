"""Surveyed points of a mission."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """A table for them."""
    op.create_table(
        "surveys",
        sa.Column("mission_id", sa.String(), nullable=False),
        sa.Column("content", sa.String(), nullable=True),
        sa.Column("used", sa.JSON(none_as_null=True), nullable=False),
        sa.Column("changed_at", sa.Double(), nullable=False),
        sa.ForeignKeyConstraint(
            ["mission_id"], ["missions.id"], name="fk_surveys_mission_id_missions", ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("mission_id", name="pk_surveys"),
    )


def downgrade() -> None:
    """They are lost."""
    op.drop_table("surveys")
