"""The tables. All times are seconds since 1970 (UTC) as floats; every row belongs to one mission."""

from __future__ import annotations

from typing import Any, ClassVar

from sqlalchemy import JSON, BigInteger, Double, ForeignKey, Index, LargeBinary, MetaData, String
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column

Json = dict[str, Any]


class Base(DeclarativeBase):
    """Names constraints the same everywhere, so that migrations can address them."""

    metadata = MetaData(
        naming_convention={
            "ix": "ix_%(table_name)s_%(column_0_N_name)s",
            "uq": "uq_%(table_name)s_%(column_0_N_name)s",
            "fk": "fk_%(table_name)s_%(column_0_name)s_%(referred_table_name)s",
            "pk": "pk_%(table_name)s",
        }
    )
    type_annotation_map: ClassVar[dict[Any, Any]] = {
        float: Double(),
        str: String(),
        Json: JSON(none_as_null=True),
        list[float]: JSON(none_as_null=True),
        bytes: LargeBinary(),
    }


def _mission_key() -> Mapped[str]:
    return mapped_column(ForeignKey("missions.id", ondelete="CASCADE"), primary_key=True)


class Mission(Base):
    """One map that grows. Its row is the lock of its mission: every writer takes it first."""

    __tablename__ = "missions"

    id: Mapped[str] = mapped_column(primary_key=True)
    name: Mapped[str]
    mode: Mapped[str]  # visual | gnss
    max_side: Mapped[int | None]
    # open | finalising | sharpening | final | deleting
    state: Mapped[str] = mapped_column(default="open", index=True)
    created_at: Mapped[float]
    world: Mapped[Json | None]  # lat_deg, lon_deg, alt_m
    zoom: Mapped[int | None]  # of the native tiles
    photo_side: Mapped[int | None]  # the longest side, in pixels, of a typical photo
    cameras: Mapped[Json] = mapped_column(default=dict)  # camera_key → fields of core.geometry.Camera
    submaps: Mapped[Json | None]  # core.submaps.SubmapGraph.to_json() of the last solve
    scale: Mapped[Json | None]  # core.scale.KnownScale.to_json()
    revision: Mapped[int] = mapped_column(default=0)  # last published
    generation: Mapped[int] = mapped_column(default=0)  # last saved poses
    event_seq: Mapped[int] = mapped_column(default=0)
    solved_frames: Mapped[int] = mapped_column(default=0)
    final_generation: Mapped[int | None]  # the poses of the final solve; None while they are to be made
    reprojection_rms_px: Mapped[float | None]
    first_upload_at: Mapped[float | None]
    last_tile_at: Mapped[float | None]
    finished_at: Mapped[float | None]
    stage_seconds: Mapped[Json] = mapped_column(default=dict)  # stage → seconds of work spent
    woken_at: Mapped[float | None]
    healed_generation: Mapped[int | None]  # the poses from which all tiles were last marked to be drawn
    pixels: Mapped[Json] = mapped_column(default=dict)  # rendered so far: new, heal, final, sharpen
    pass_pixels: Mapped[int | None] = mapped_column(BigInteger)  # what one pass over all tiles takes
    backfill: Mapped[bool] = mapped_column(default=False)  # drawn at full resolution once it is final
    full: Mapped[bool] = mapped_column(default=False)  # that has happened: `max_side` no longer counts
    sharp_zoom: Mapped[int | None]  # of the tiles that are being drawn at full resolution
    sharp_tiles: Mapped[int | None]  # how many these are

    @property
    def drawn_side(self) -> int | None:
        """The longest side, in pixels, at which photos are drawn; None: as they are."""
        return None if self.full else self.max_side

    @property
    def tile_side(self) -> int | None:
        """The same for the tiles that are drawn now."""
        return None if self.state == "sharpening" else self.drawn_side

    @property
    def tile_zoom(self) -> int | None:
        """The zoom of the tiles that are drawn now."""
        return self.zoom if self.sharp_zoom is None else self.sharp_zoom


class Frame(Base):
    """One photo and how far it has come."""

    __tablename__ = "frames"
    __table_args__ = (
        Index("ix_frames_mission_id_state", "mission_id", "state"),
        Index("ix_frames_mission_id_received_at_id", "mission_id", "received_at", "id"),
        Index("ix_frames_state_received_at", "state", "received_at"),
        Index("ix_frames_ready_at", "ready_at"),
        Index("ix_frames_mission_id_ready_at", "mission_id", "ready_at"),
        Index("ix_frames_matched_at", "matched_at"),
    )

    mission_id: Mapped[str] = _mission_key()
    id: Mapped[str] = mapped_column(primary_key=True)
    name: Mapped[str]
    size_bytes: Mapped[int]
    media_type: Mapped[str | None]
    width: Mapped[int | None]
    height: Mapped[int | None]
    state: Mapped[str]  # received | ready | matched | posed | fused | waiting | rejected
    reason_code: Mapped[str | None]
    reason: Mapped[str | None]
    meta: Mapped[Json | None]  # core.frame.FrameMeta
    looks: Mapped[bytes | None] = mapped_column(deferred=True)  # core.vocabulary.looks
    telemetry: Mapped[Json | None]
    received_at: Mapped[float]
    ready_at: Mapped[float | None]
    matched_at: Mapped[float | None]
    posed_at: Mapped[float | None]
    fused_at: Mapped[float | None]
    woken_at: Mapped[float | None]
    attempts: Mapped[int] = mapped_column(default=0)  # how often a worker has begun to read it
    island: Mapped[Json | None]  # core.geometry.Pose on the island of one that waits; None: it is alone


class Pair(Base):
    """Two frames that may show the same ground: claimed by who shall compute it, then its matches."""

    __tablename__ = "pairs"
    __table_args__ = (
        Index("ix_pairs_mission_id_high", "mission_id", "high"),
        Index("ix_pairs_mission_id_state_accepted", "mission_id", "state", "accepted"),
    )

    mission_id: Mapped[str] = _mission_key()
    low: Mapped[str] = mapped_column(primary_key=True)
    high: Mapped[str] = mapped_column(primary_key=True)
    proposer: Mapped[str]  # a frame's id, or "" for the final solve
    state: Mapped[str]  # claimed | done
    accepted: Mapped[bool] = mapped_column(default=False)
    reason: Mapped[str | None]
    inliers: Mapped[int] = mapped_column(default=0)
    counts: Mapped[Json | None]
    matches: Mapped[bytes | None]  # core.matching.PairMatch


class FramePose(Base):
    """Where a frame was taken, as of `generation`, and the native tiles that its footprint touches."""

    __tablename__ = "frame_poses"
    __table_args__ = (Index("ix_frame_poses_mission_id_z_x0", "mission_id", "z", "x0"),)

    mission_id: Mapped[str] = _mission_key()
    frame_id: Mapped[str] = mapped_column(primary_key=True)
    generation: Mapped[int]
    camera_key: Mapped[str]
    source: Mapped[str]
    submap: Mapped[int]
    rotation: Mapped[list[float]]  # world_R_cam, row by row
    center: Mapped[list[float]]
    ground_h_m: Mapped[float]
    sigma_m: Mapped[list[float] | None]
    gain: Mapped[list[float]]
    z: Mapped[int]
    x0: Mapped[int]
    y0: Mapped[int]
    x1: Mapped[int]  # inclusive
    y1: Mapped[int]


class Lease(Base):
    """Who may sequence a mission; `epoch` rises with every owner and fences the former one off."""

    __tablename__ = "leases"

    mission_id: Mapped[str] = _mission_key()
    owner: Mapped[str]
    epoch: Mapped[int]
    expires_at: Mapped[float]


class Tile(Base):
    """What a tile shows now. No object: it is empty.

    `inputs`: a digest of all that it was drawn from; None for overviews and for what was drawn in parts.
    """

    __tablename__ = "tiles"

    mission_id: Mapped[str] = _mission_key()
    z: Mapped[int] = mapped_column(primary_key=True)
    x: Mapped[int] = mapped_column(primary_key=True)
    y: Mapped[int] = mapped_column(primary_key=True)
    revision: Mapped[int]
    generation: Mapped[int]
    object_key: Mapped[str | None]
    etag: Mapped[str | None]
    media_type: Mapped[str | None]
    size_bytes: Mapped[int] = mapped_column(default=0)
    inputs: Mapped[str | None]


class TileVersion(Base):
    """What a tile showed from `revision` on, until its next version."""

    __tablename__ = "tile_versions"

    mission_id: Mapped[str] = _mission_key()
    z: Mapped[int] = mapped_column(primary_key=True)
    x: Mapped[int] = mapped_column(primary_key=True)
    y: Mapped[int] = mapped_column(primary_key=True)
    revision: Mapped[int] = mapped_column(primary_key=True)
    object_key: Mapped[str | None]
    etag: Mapped[str | None]
    media_type: Mapped[str | None]
    size_bytes: Mapped[int] = mapped_column(default=0)


class DirtyTile(Base):
    """A native tile that must be rendered: made by poses of `generation`, gone once that is published.

    `since`: the oldest generation that is not published yet. `rendered`: what was made and waits for
    publication, from the poses of `rendered_generation`.
    """

    __tablename__ = "dirty_tiles"

    mission_id: Mapped[str] = _mission_key()
    z: Mapped[int] = mapped_column(primary_key=True)
    x: Mapped[int] = mapped_column(primary_key=True)
    y: Mapped[int] = mapped_column(primary_key=True)
    generation: Mapped[int]
    since: Mapped[int]
    priority: Mapped[int]  # 0 first
    claimed_at: Mapped[float | None]
    rendered_generation: Mapped[int | None]
    rendered: Mapped[Json | None]  # object_key, etag, media_type, size_bytes; or {"empty": true}


class Event(Base):
    """What viewers are told; `seq` is dense and in the order of the commits."""

    __tablename__ = "events"

    mission_id: Mapped[str] = _mission_key()
    seq: Mapped[int] = mapped_column(primary_key=True)
    kind: Mapped[str]  # frame | tiles | mission | export
    payload: Mapped[Json]
    at: Mapped[float]


class Export(Base):
    """A file made from the mission as it was at `revision` and `generation`."""

    __tablename__ = "exports"

    mission_id: Mapped[str] = _mission_key()
    name: Mapped[str] = mapped_column(primary_key=True)
    revision: Mapped[int]
    generation: Mapped[int]
    state: Mapped[str]  # wanted | ready | failed
    object_key: Mapped[str | None]
    size_bytes: Mapped[int | None] = mapped_column(BigInteger)
    media_type: Mapped[str | None]
    error: Mapped[str | None]
    requested_at: Mapped[float]
    finished_at: Mapped[float | None]
    woken_at: Mapped[float | None]


class Survey(Base):
    """The mission's surveyed points as they were sent; `content` None: they were taken back."""

    __tablename__ = "surveys"

    mission_id: Mapped[str] = _mission_key()
    content: Mapped[str | None]
    used: Mapped[list[str]] = mapped_column(JSON(none_as_null=True))  # points that hold the map in place
    changed_at: Mapped[float]
    measured: Mapped[Json | None]  # generation, revision, and what the mosaic of then says of the points
