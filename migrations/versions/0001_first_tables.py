"""The first tables."""

from __future__ import annotations

from typing import Any

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Everything that a mission consists of."""
    _create_missions()
    _create_frames()
    _create_pairs()
    _create_poses()
    _create_tiles()
    _create_dirty_tiles()
    _create_events()
    _create_exports()


def downgrade() -> None:
    """Nothing is left."""
    for name in (
        "exports",
        "events",
        "dirty_tiles",
        "tile_versions",
        "tiles",
        "leases",
        "frame_poses",
        "pairs",
        "frames",
        "missions",
    ):
        op.drop_table(name)


def _create(name: str, key: tuple[str, ...], *columns: sa.Column[Any]) -> None:
    """A table of things that belong to one mission and go with it."""
    op.create_table(
        name,
        sa.Column("mission_id", sa.String(), nullable=False),
        *columns,
        sa.ForeignKeyConstraint(
            ["mission_id"], ["missions.id"], name=f"fk_{name}_mission_id_missions", ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("mission_id", *key, name=f"pk_{name}"),
    )


def _string(name: str, nullable: bool = False) -> sa.Column[Any]:
    return sa.Column(name, sa.String(), nullable=nullable)


def _integer(name: str, nullable: bool = False) -> sa.Column[Any]:
    return sa.Column(name, sa.Integer(), nullable=nullable)


def _double(name: str, nullable: bool = False) -> sa.Column[Any]:
    return sa.Column(name, sa.Double(), nullable=nullable)


def _json(name: str, nullable: bool = False) -> sa.Column[Any]:
    return sa.Column(name, sa.JSON(none_as_null=True), nullable=nullable)


def _create_missions() -> None:
    op.create_table(
        "missions",
        *(_string(name) for name in ("id", "name", "mode", "state")),
        _integer("max_side", nullable=True),
        _double("created_at"),
        _json("world", nullable=True),
        _integer("zoom", nullable=True),
        _json("cameras"),
        *(_integer(name) for name in ("revision", "generation", "event_seq", "solved_frames")),
        _integer("final_generation", nullable=True),
        _double("reprojection_rms_px", nullable=True),
        *(
            _double(f"{what}_at", nullable=True)
            for what in ("first_upload", "last_tile", "finished", "woken")
        ),
        _json("stage_seconds"),
        sa.PrimaryKeyConstraint("id", name="pk_missions"),
    )
    op.create_index("ix_missions_state", "missions", ["state"])


def _create_frames() -> None:
    _create(
        "frames",
        ("id",),
        *(_string(name) for name in ("id", "name", "state")),
        _integer("size_bytes"),
        *(_string(name, nullable=True) for name in ("media_type", "reason_code", "reason")),
        *(_integer(name, nullable=True) for name in ("width", "height")),
        *(_json(name, nullable=True) for name in ("meta", "telemetry")),
        _double("received_at"),
        *(_double(f"{what}_at", nullable=True) for what in ("ready", "matched", "posed", "fused", "woken")),
        _integer("attempts"),
    )
    op.create_index("ix_frames_mission_id_state", "frames", ["mission_id", "state"])
    op.create_index("ix_frames_mission_id_received_at_id", "frames", ["mission_id", "received_at", "id"])
    op.create_index("ix_frames_state_received_at", "frames", ["state", "received_at"])
    op.create_index("ix_frames_ready_at", "frames", ["ready_at"])
    op.create_index("ix_frames_matched_at", "frames", ["matched_at"])


def _create_pairs() -> None:
    _create(
        "pairs",
        ("low", "high"),
        *(_string(name) for name in ("low", "high", "proposer", "state")),
        sa.Column("accepted", sa.Boolean(), nullable=False),
        _string("reason", nullable=True),
        _integer("inliers"),
        _json("counts", nullable=True),
        sa.Column("matches", sa.LargeBinary(), nullable=True),
    )
    op.create_index("ix_pairs_mission_id_high", "pairs", ["mission_id", "high"])
    op.create_index("ix_pairs_mission_id_state_accepted", "pairs", ["mission_id", "state", "accepted"])


def _create_poses() -> None:
    _create(
        "frame_poses",
        ("frame_id",),
        *(_string(name) for name in ("frame_id", "camera_key", "source")),
        *(_integer(name) for name in ("generation", "submap")),
        *(_json(name) for name in ("rotation", "center", "gain")),
        _double("ground_h_m"),
        _json("sigma_m", nullable=True),
        *(_integer(name) for name in ("z", "x0", "y0", "x1", "y1")),
    )
    op.create_index("ix_frame_poses_mission_id_z_x0", "frame_poses", ["mission_id", "z", "x0"])
    _create("leases", (), _string("owner"), _integer("epoch"), _double("expires_at"))


def _create_tiles() -> None:
    _create("tiles", ("z", "x", "y"), *_tile_columns(), _integer("generation"))
    _create("tile_versions", ("z", "x", "y", "revision"), *_tile_columns())


def _tile_columns() -> list[sa.Column[Any]]:
    return [
        *(_integer(name) for name in ("z", "x", "y", "revision")),
        *(_string(name, nullable=True) for name in ("object_key", "etag", "media_type")),
        _integer("size_bytes"),
    ]


def _create_dirty_tiles() -> None:
    _create(
        "dirty_tiles",
        ("z", "x", "y"),
        *(_integer(name) for name in ("z", "x", "y", "generation", "since", "priority")),
        _double("claimed_at", nullable=True),
        _integer("rendered_generation", nullable=True),
        _json("rendered", nullable=True),
    )


def _create_events() -> None:
    _create("events", ("seq",), _integer("seq"), _string("kind"), _json("payload"), _double("at"))


def _create_exports() -> None:
    _create(
        "exports",
        ("name",),
        *(_string(name) for name in ("name", "state")),
        *(_integer(name) for name in ("revision", "generation")),
        *(_string(name, nullable=True) for name in ("object_key", "media_type", "error")),
        sa.Column("size_bytes", sa.BigInteger(), nullable=True),
        _double("requested_at"),
        *(_double(f"{what}_at", nullable=True) for what in ("finished", "woken")),
    )
