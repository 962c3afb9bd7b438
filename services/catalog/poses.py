"""Poses: what the sequencer decided, saved with all its consequences in one transaction."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from sqlalchemy import delete, func, select
from sqlalchemy.orm import Session

from core.geometry import Camera, Pose, PosedFrame, World
from services.catalog import frames, leases, sharpening, tiles
from services.catalog.rows import chunks, clock, insert, lock, mission
from services.catalog.tiles import Key, TileBox
from services.tables import FramePose, Mission


@dataclass(frozen=True, slots=True)
class Placed:
    """One frame on the map; `box`: the native tiles that its footprint touches.

    `generation`: of which save this is; set when read, ignored when saved.
    """

    frame_id: str
    camera_key: str
    pose: Pose
    box: TileBox
    gain: tuple[float, float, float] = (1.0, 1.0, 1.0)
    generation: int = 0

    def posed(self, cameras: Mapping[str, Camera]) -> PosedFrame:
        """The same as what core draws from."""
        return PosedFrame(self.frame_id, cameras[self.camera_key], self.pose, self.gain)


@dataclass(frozen=True, slots=True)
class PoseUpdate:
    """What one run of the sequencer decided. What is None, or not mentioned, stays as it is.

    `placed`: new and moved frames, unchanged ones are welcome. `unplaced`: frame_id → (code, sentence).
    `waiting`: frames that wait for a tie, with the pose on their island; None for one that is alone.
    `dirty`: native tile → priority (0 first), all that now look different. `cameras`: refined, by key.
    `photo_side`: the longest side of a typical photo, pixels.
    `solved_frames`: frames in the global solve, when this was one; `submaps`: what it was made of. `final`:
    it was the canonical one. `pass_pixels`: what drawing all tiles once takes.
    """

    placed: Sequence[Placed] = ()
    unplaced: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    waiting: Mapping[str, Pose | None] = field(default_factory=dict)
    dirty: Mapping[Key, int] = field(default_factory=dict)
    cameras: Mapping[str, Camera] = field(default_factory=dict)
    world: World | None = None
    zoom: int | None = None
    photo_side: int | None = None
    solved_frames: int | None = None
    reprojection_rms_px: float | None = None
    submaps: Mapping[str, Any] | None = None
    pass_pixels: int | None = None
    final: bool = False


@dataclass(frozen=True, slots=True)
class Poses:
    """The mission's poses as of `generation`; `placed` by frame id, in its order.

    `waiting`: as in PoseUpdate; empty when only a part of the map was read. `photo_side`: of a typical photo,
    `max_side`: at which photos are drawn at most, pixels.
    """

    generation: int
    world: World | None
    zoom: int | None
    cameras: Mapping[str, Camera]
    placed: Mapping[str, Placed]
    solved_frames: int
    final_generation: int | None
    waiting: Mapping[str, Pose | None] = field(default_factory=dict)
    photo_side: int | None = None
    max_side: int | None = None


def save(tx: Session, mission_id: str, epoch: int, change: PoseUpdate, now: float | None = None) -> int:
    """Write `change`, pose and reject its frames, mark its tiles dirty; the new generation.

    Raises LeaseLost, and writes nothing, unless `epoch` is the present owner's.
    """
    leases.guard(tx, mission_id, epoch)
    row = lock(tx, mission_id)
    now = clock(now)
    row.generation += 1
    row.woken_at = now
    _save_mission(row, change)
    _upsert(tx, mission_id, row.generation, change.placed)
    _delete(tx, mission_id, sorted({*change.unplaced, *change.waiting}))
    frames.mark_unplaced(tx, mission_id, change.unplaced, now)
    islands = {k: None if pose is None else _pose_document(pose) for k, pose in change.waiting.items()}
    frames.mark_waiting(tx, mission_id, islands, now)
    frames.mark_posed(tx, mission_id, [p.frame_id for p in change.placed], now)
    tiles.mark_dirty(tx, mission_id, change.dirty, row.generation)
    return row.generation


def lose(tx: Session, mission_id: str, frame_id: str, now: float | None = None) -> None:
    """Take a frame off the map whose photo is gone; what was solved as final is solved again without it."""
    row = lock(tx, mission_id)
    frames.mark_lost(tx, mission_id, frame_id, now)
    _delete(tx, mission_id, [frame_id])
    row.generation += 1
    row.final_generation = None
    if row.state == "sharpening":
        sharpening.undo(tx, row, clock(now))
        row.state = "finalising"


def load(tx: Session, mission_id: str, box: TileBox | None = None) -> Poses:
    """All poses, or those of the frames whose footprints touch tiles of `box`."""
    row = mission(tx, mission_id)
    query = select(FramePose).where(FramePose.mission_id == mission_id).order_by(FramePose.frame_id)
    if box is not None:
        query = query.where(
            FramePose.z == box.z,
            FramePose.x0 <= box.x1,
            FramePose.x1 >= box.x0,
            FramePose.y0 <= box.y1,
            FramePose.y1 >= box.y0,
        )
    placed = [_placed(pose) for pose in tx.scalars(query.execution_options(populate_existing=True))]
    return Poses(
        generation=row.generation,
        world=World(**row.world) if row.world else None,
        zoom=row.zoom,
        cameras={key: _camera(row.cameras[key]) for key in sorted(row.cameras)},
        placed={p.frame_id: p for p in placed},
        solved_frames=row.solved_frames,
        final_generation=row.final_generation,
        waiting=waiting(tx, mission_id) if box is None else {},
        photo_side=row.photo_side,
        max_side=row.drawn_side,
    )


def waiting(tx: Session, mission_id: str) -> Mapping[str, Pose | None]:
    """The frames that wait for a tie, by id, with the pose on their island; None for one that is alone."""
    found = frames.islands(tx, mission_id)
    return {k: None if island is None else _pose(island) for k, island in found.items()}


def maps(tx: Session, mission_id: str) -> Mapping[int, Mapping[str, int]]:
    """Each connected map's frames as of now, counted by the source of their poses."""
    query = (
        select(FramePose.submap, FramePose.source, func.count())
        .where(FramePose.mission_id == mission_id)
        .group_by(FramePose.submap, FramePose.source)
        .order_by(FramePose.submap, FramePose.source)
    )
    found: dict[int, dict[str, int]] = {}
    for submap, source, count in tx.execute(query):
        found.setdefault(submap, {})[source] = count
    return found


def georeferenced(tx: Session, mission_id: str) -> bool | None:
    """Whether the map lies where GPS says; None when nothing is placed."""
    query = select(FramePose.source).where(FramePose.mission_id == mission_id)
    some = tx.scalars(query.limit(1)).first()  # a map is local as a whole, or not at all
    return None if some is None else some != "vision-only"


def _save_mission(row: Mission, change: PoseUpdate) -> None:
    if change.world is not None:
        row.world = {k: float(v) for k, v in asdict(change.world).items()}
    if change.zoom is not None:
        row.zoom = int(change.zoom)
    if change.photo_side is not None:
        row.photo_side = int(change.photo_side)
    if change.cameras:
        row.cameras = row.cameras | {key: _camera_json(c) for key, c in change.cameras.items()}
    if change.solved_frames is not None:
        row.solved_frames = change.solved_frames
    if change.reprojection_rms_px is not None:
        row.reprojection_rms_px = float(change.reprojection_rms_px)
    if change.submaps is not None:
        row.submaps = dict(change.submaps)
    if change.pass_pixels is not None:
        row.pass_pixels = change.pass_pixels
    if change.final:
        row.final_generation = row.healed_generation = row.generation


def _camera_json(camera: Camera) -> dict[str, Any]:
    size = {"width": int(camera.width), "height": int(camera.height)}
    lens = {name: float(getattr(camera, name)) for name in ("f_px", "cx", "cy", "k1", "k2")}
    return size | lens | {"falloff": [float(v) for v in camera.falloff]}


def _camera(document: Mapping[str, Any]) -> Camera:
    return Camera(**{**document, "falloff": tuple(document.get("falloff", ()))})


def _upsert(tx: Session, mission_id: str, generation: int, placed: Sequence[Placed]) -> None:
    rows = {p.frame_id: _row(mission_id, p) for p in placed}
    for some in chunks(sorted(rows)):
        query = select(FramePose).where(FramePose.mission_id == mission_id, FramePose.frame_id.in_(some))
        for old in tx.scalars(query.execution_options(populate_existing=True)):
            if all(getattr(old, name) == value for name, value in rows[old.frame_id].items()):
                del rows[old.frame_id]
    if not rows:
        return
    upsert = insert(tx, FramePose)
    names = [*next(iter(rows.values())), "generation"]
    upsert = upsert.on_conflict_do_update(
        index_elements=["mission_id", "frame_id"], set_={name: upsert.excluded[name] for name in names}
    )
    tx.execute(upsert, [rows[key] | {"generation": generation} for key in sorted(rows)])


def _delete(tx: Session, mission_id: str, frame_ids: Collection[str]) -> None:
    for some in chunks(frame_ids):
        tx.execute(
            delete(FramePose)
            .where(FramePose.mission_id == mission_id, FramePose.frame_id.in_(some))
            .execution_options(synchronize_session=False)
        )


def _row(mission_id: str, placed: Placed) -> dict[str, Any]:
    pose, box = placed.pose, placed.box
    return (
        {
            "mission_id": mission_id,
            "frame_id": placed.frame_id,
            "camera_key": placed.camera_key,
            "gain": [float(g) for g in placed.gain],
        }
        | _pose_document(pose)
        | {name: int(value) for name, value in asdict(box).items()}
    )


def _pose_document(pose: Pose) -> dict[str, Any]:
    return {
        "source": pose.source,
        "submap": int(pose.submap),
        "rotation": np.asarray(pose.world_R_cam, float).reshape(9).tolist(),
        "center": np.asarray(pose.center, float).reshape(3).tolist(),
        "ground_h_m": float(pose.ground_h_m),
        "sigma_m": None if pose.sigma_m is None else [float(s) for s in pose.sigma_m],
    }


def _pose(document: Mapping[str, Any]) -> Pose:
    sigma = document["sigma_m"]
    return Pose(
        world_R_cam=np.array(document["rotation"], float).reshape(3, 3),
        center=np.array(document["center"], float),
        ground_h_m=document["ground_h_m"],
        source=document["source"],
        submap=document["submap"],
        sigma_m=None if sigma is None else (sigma[0], sigma[1], sigma[2]),
    )


_POSE_COLUMNS = ("source", "submap", "rotation", "center", "ground_h_m", "sigma_m")


def _placed(row: FramePose) -> Placed:
    pose = _pose({name: getattr(row, name) for name in _POSE_COLUMNS})
    box = TileBox(row.z, row.x0, row.y0, row.x1, row.y1)
    gain = (row.gain[0], row.gain[1], row.gain[2])
    return Placed(row.frame_id, row.camera_key, pose, box, gain, row.generation)
