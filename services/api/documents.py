"""The API's documents: what goes in and out as JSON, and how rows become it."""

from __future__ import annotations

from typing import Annotated, Literal, cast

from pydantic import AfterValidator, BaseModel, Field, model_validator
from sqlalchemy.orm import Session

from core.scale import LONGEST_M, KnownScale
from services.catalog import frames, missions, poses
from services.report import latency
from services.tables import Export, Frame, Mission

FrameState = Literal["received", "ready", "matched", "posed", "fused", "waiting", "rejected"]
MissionState = Literal["open", "finalising", "sharpening", "final", "deleting"]
ExportState = Literal["available", "wanted", "ready", "failed"]
Mode = Literal["visual", "gnss"]


def _one_line(text: str) -> str:
    shown = "".join(c for c in text if c.isprintable()).strip()
    if not shown:
        raise ValueError("a name needs at least one letter that can be seen")
    return shown


Pixel = tuple[Annotated[float, Field(allow_inf_nan=False)], Annotated[float, Field(allow_inf_nan=False)]]
Metres = Annotated[float, Field(gt=0, lt=LONGEST_M, allow_inf_nan=False)]


class MarkerIn(BaseModel):
    """Something straight of known length on the ground, as one photo shows it."""

    photo: Annotated[str, Field(min_length=1, max_length=1000, description="The photo's name")]
    pixels: tuple[Pixel, Pixel] = Field(description="Its two ends, u and v in the original photo")
    length_m: Metres


class ScaleIn(BaseModel):
    """What is known of the scale where GPS cannot tell it: one of the two, or neither."""

    first_height_m: Metres | None = Field(None, description="Of the first photo above ground")
    marker: MarkerIn | None = None

    @model_validator(mode="after")
    def _one_of_them(self) -> ScaleIn:
        if self.first_height_m is not None and self.marker is not None:
            raise ValueError("give a first height or a marker, not both")
        return self

    def known(self) -> KnownScale:
        """As core knows it. Raises BadScale."""
        return KnownScale.from_json(self.model_dump())


class MissionIn(BaseModel):
    """A new mission. `mode`: visual (match photos) or gnss (position and heading only)."""

    name: Annotated[str, Field(max_length=120), AfterValidator(_one_line)] = "Mission"
    mode: Mode = "visual"
    max_side: Annotated[int, Field(ge=256, le=65535)] | None = Field(
        None, description="Longest side, in pixels, at which photos are drawn; null: as they are"
    )
    backfill: bool = Field(
        False, description="Draw the map from the full photos, tile by tile, once it is final at `max_side`"
    )
    scale: ScaleIn | None = Field(None, description="For photos without GPS; it can be given later as well")


class Latency(BaseModel):
    """Seconds from upload to visible tile."""

    p50: float
    p95: float


class ProgressOut(BaseModel):
    """How far a mission has come. `counts`: frames by state; `dirty_tiles`: still to be drawn anew."""

    state: MissionState
    counts: dict[FrameState, int]
    total: int
    revision: int
    generation: int
    tiles: int
    dirty_tiles: int
    idle: bool = Field(description="Nothing is left to do with the photos that are there")
    rate_per_s: float | None = Field(
        description="Photos put on the map per second, over the last half minute"
    )
    latency_s: Latency | None
    reprojection_rms_px: float | None
    first_upload_at: float | None
    last_tile_at: float | None
    finished_at: float | None
    sharpened: float | None = Field(
        description="How much of the map is drawn at full resolution, 0 to 1, while that is done"
    )
    event_seq: int


class MissionOut(BaseModel):
    """A mission. `zoom`: of its finest 512 px tiles, null until the first photo is placed. `backfill`: it is
    drawn from the full photos once it is final.
    """

    id: str
    name: str
    mode: Mode
    max_side: int | None
    backfill: bool
    state: MissionState
    created_at: float
    zoom: int | None
    scale: ScaleIn | None
    georeferenced: bool | None = Field(
        description="Whether the map lies where GPS says; false: no photo has any, place and north are "
        "assumed; null: there is no map yet"
    )
    event_seq: int = Field(description="Number of the last event: listen from here on")
    url: str = Field(description="The live map's page")
    progress: ProgressOut


class MissionPage(BaseModel):
    """Missions, newest first; `next` is the `after` of the next page, null on the last one."""

    missions: list[MissionOut]
    next: str | None


class FrameOut(BaseModel):
    """One photo. Rejected ones say why: `code` for programs, `reason` for people."""

    frame_id: str
    name: str
    state: FrameState
    code: str | None
    reason: str | None
    size_bytes: int
    width: int | None
    height: int | None
    received_at: float
    fused_at: float | None


class FramePage(BaseModel):
    """Frames in the order of arrival; `next` is the `after` of the next page, null on the last one."""

    frames: list[FrameOut]
    next: str | None


class UploadedFrame(BaseModel):
    """What became of one photo of an upload. `created`: it is new; the same photo again is the same frame."""

    name: str
    frame_id: str
    state: FrameState
    created: bool
    code: str | None = None
    detail: str | None = None


class UploadOut(BaseModel):
    """One result per photo, in the order of the request."""

    frames: list[UploadedFrame]


class ExportOut(BaseModel):
    """A file that can be had. `available`: it is made when somebody asks for it."""

    name: str
    state: ExportState
    size_bytes: int | None = None
    media_type: str | None = None
    revision: int | None = None
    error: str | None = None
    url: str


class ExportList(BaseModel):
    """Every export by name."""

    exports: list[ExportOut]


def progress_document(tx: Session, mission_id: str) -> ProgressOut:
    """The mission's progress as of now; raises MissionNotFound."""
    row = missions.get(tx, mission_id)
    known = missions.progress(tx, mission_id)
    return ProgressOut(
        state=cast(MissionState, known.state),
        counts={cast(FrameState, state): n for state, n in known.counts.items()},
        total=known.frames,
        revision=known.revision,
        generation=known.generation,
        tiles=known.tiles,
        dirty_tiles=known.dirty,
        idle=known.idle,
        rate_per_s=known.fused_per_s or None,
        latency_s=_latency(tx, mission_id) if known.counts["fused"] else None,
        reprojection_rms_px=row.reprojection_rms_px,
        first_upload_at=known.first_upload_at,
        last_tile_at=known.last_tile_at,
        finished_at=known.finished_at,
        sharpened=known.sharpened,
        event_seq=known.event_seq,
    )


def mission_document(tx: Session, row: Mission, public_url: str) -> MissionOut:
    """The mission with its progress."""
    return MissionOut(
        id=row.id,
        name=row.name,
        mode=cast(Mode, row.mode),
        max_side=row.max_side,
        backfill=row.backfill,
        state=cast(MissionState, row.state),
        created_at=row.created_at,
        zoom=row.tile_zoom,
        scale=None if row.scale is None else ScaleIn.model_validate(row.scale),
        georeferenced=poses.georeferenced(tx, row.id),
        event_seq=row.event_seq,
        url=f"{public_url}/missions/{row.id}",
        progress=progress_document(tx, row.id),
    )


def frame_document(row: Frame) -> FrameOut:
    """The frame as its list shows it."""
    return FrameOut(
        frame_id=row.id,
        name=row.name,
        state=cast(FrameState, row.state),
        code=row.reason_code,
        reason=row.reason,
        size_bytes=row.size_bytes,
        width=row.width,
        height=row.height,
        received_at=row.received_at,
        fused_at=row.fused_at,
    )


def export_document(name: str, row: Export | None, url: str) -> ExportOut:
    """The export, asked for or not."""
    if row is None:
        return ExportOut(name=name, state="available", url=url)
    return ExportOut(
        name=name,
        state=cast(ExportState, row.state),
        size_bytes=row.size_bytes if row.state == "ready" else None,
        media_type=row.media_type if row.state == "ready" else None,
        revision=row.revision,
        error=row.error,
        url=url,
    )


def _latency(tx: Session, mission_id: str) -> Latency | None:
    known = latency(frames.latencies_s(tx, mission_id))
    return Latency(**known) if known else None
