"""What live neighbours are found by lies with the frame: no features file need be read for it."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0007"
down_revision = "0006"
branch_labels = None
depends_on = None

INDEX = "ix_frames_mission_id_ready_at"


def upgrade() -> None:
    """Frames that are there are found by place and time only; the final solve looks at their features."""
    op.add_column("frames", sa.Column("looks", sa.LargeBinary(), nullable=True))
    op.create_index(INDEX, "frames", ["mission_id", "ready_at"])


def downgrade() -> None:
    """Older code reads the features files."""
    op.drop_index(INDEX, "frames")
    op.drop_column("frames", "looks")
