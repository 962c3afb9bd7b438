"""What tiles were drawn from, what drawing has cost, and maps that sharpen after they are final."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0005"
down_revision = "0004"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Tiles that were drawn before are drawn anew by the next final pass."""
    op.add_column("tiles", sa.Column("inputs", sa.String(), nullable=True))
    op.add_column("missions", sa.Column("healed_generation", sa.Integer(), nullable=True))
    op.add_column("missions", sa.Column("pass_pixels", sa.BigInteger(), nullable=True))
    op.add_column("missions", sa.Column("pixels", sa.JSON(), nullable=False, server_default="{}"))
    for flag in ("backfill", "full"):
        op.add_column("missions", sa.Column(flag, sa.Boolean(), nullable=False, server_default=sa.false()))
    op.add_column("missions", sa.Column("sharp_zoom", sa.Integer(), nullable=True))
    op.add_column("missions", sa.Column("sharp_tiles", sa.Integer(), nullable=True))


def downgrade() -> None:
    """A map that was being sharpened stays as far as it came."""
    op.drop_column("tiles", "inputs")
    for name in (
        "healed_generation", "pass_pixels", "pixels", "backfill", "full", "sharp_zoom", "sharp_tiles",
    ):  # fmt: skip
        op.drop_column("missions", name)
