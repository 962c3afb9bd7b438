"""Missions: open → finalising (→ sharpening) → final, and open again when another photo comes."""

from __future__ import annotations

import secrets
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sqlalchemy import ColumnElement, bindparam, exists, func, select, tuple_, update
from sqlalchemy import delete as delete_rows
from sqlalchemy.orm import Session

from core.scale import UNKNOWN, KnownScale
from services.catalog import events, frames, leases, sharpening, tiles
from services.catalog.rows import MISSION, clock, hold, in_step, lock, mission, table
from services.catalog.wakes import Wake
from services.errors import MissionNotFound
from services.tables import DirtyTile, Frame, Mission, Tile

_ALPHABET = "abcdefghijkmnpqrstuvwxyz23456789"  # no l, o, 0, 1: ids are read out over the radio
_RATE_WINDOW_S = 30.0
_ENDING = ("finalising", "sharpening")
_UNDER_WAY = ("open", *_ENDING)

_STATE = select(MISSION.state).where(MISSION.id == bindparam("mission"))
_SPENT = select(MISSION.stage_seconds).where(MISSION.id == bindparam("mission"))
_PIXELS = select(MISSION.pixels).where(MISSION.id == bindparam("mission"))
_FRAME, _TILE = table(Frame).c, table(Tile).c
_BY_STATE = (
    select(_FRAME.state, func.count()).where(_FRAME.mission_id == bindparam("mission")).group_by(_FRAME.state)
)
_FUSED = select(func.count()).where(
    _FRAME.mission_id == bindparam("mission"), _FRAME.fused_at > bindparam("since")
)
_SHOWN = select(func.count()).where(_TILE.mission_id == bindparam("mission"), _TILE.object_key.is_not(None))
_CHANGE = update(table(Mission)).where(MISSION.id == bindparam("mission"))


@dataclass(frozen=True, slots=True)
class Progress:
    """How far a mission has come.

    `counts`: frames by state, every state named. `tiles`: those that show something, overviews included.
    `dirty`: native tiles still to be shown anew. `fused_per_s`: over the last half minute. `sharpened`: how
    much is drawn at full resolution, 0 … 1, while that is done.
    """

    mission_id: str
    state: str
    frames: int
    counts: Mapping[str, int]
    revision: int
    generation: int
    tiles: int
    dirty: int
    fused_per_s: float
    event_seq: int
    first_upload_at: float | None
    last_tile_at: float | None
    finished_at: float | None
    sharpened: float | None = None

    @property
    def idle(self) -> bool:
        """Whether nothing is left to do with the photos that are there."""
        waiting = ("received", "ready", "matched", "posed")
        return not self.dirty and not any(self.counts[state] for state in waiting)


def create(
    tx: Session,
    name: str,
    mode: str = "visual",
    max_side: int | None = None,
    now: float | None = None,
    scale: KnownScale = UNKNOWN,
    backfill: bool = False,
) -> Mission:
    """A new, empty mission. `mode`: visual or gnss; `max_side`: px to work on; None: all; `backfill`: draw it
    from the full photos once it is final.
    """
    row = Mission(
        id="".join(secrets.choice(_ALPHABET) for _ in range(10)),
        name=name.replace("\x00", ""),
        mode=mode,
        max_side=max_side,
        state="open",
        created_at=clock(now),
        cameras={},
        stage_seconds={},
        scale=scale.to_json(),
        pixels={},
        backfill=backfill,
        full=False,
    )
    tx.add(row)
    tx.flush()
    return row


def get(tx: Session, mission_id: str) -> Mission:
    """The mission's row; raises MissionNotFound."""
    return mission(tx, mission_id)


def check(tx: Session, mission_id: str) -> None:
    """Raises MissionNotFound when there is none or it is being deleted."""
    if tx.execute(_STATE, {"mission": mission_id}).scalar() in (None, "deleting"):
        raise MissionNotFound(f"There is no mission {mission_id!r}.")


def list(tx: Session, limit: int = 100, after: str | None = None) -> Sequence[Mission]:
    """Missions, newest first, from the one after mission `after` on, at most `limit`."""
    query = select(Mission).where(Mission.state != "deleting")
    if after is not None:
        last = mission(tx, after)
        query = query.where(tuple_(Mission.created_at, Mission.id) < tuple_(last.created_at, last.id))
    return tx.scalars(query.order_by(Mission.created_at.desc(), Mission.id.desc()).limit(limit)).all()


def active(tx: Session) -> Sequence[Mission]:
    """Missions that have work left: finalising, or with a frame or tile that is still on its way."""
    query = select(Mission).where(Mission.state.in_(_UNDER_WAY), _has_work()).order_by(Mission.id)
    return tx.scalars(query).all()


def request_finalise(tx: Session, mission_id: str, now: float | None = None) -> Mission:
    """Open → finalising; a mission that is further stays so."""
    row = lock(tx, mission_id)
    now = clock(now)
    if row.state == "open":
        row.state, row.final_generation, row.woken_at = "finalising", None, now
        events.append(tx, mission_id, "mission", {"state": "finalising"}, now)
    return row


def finish(tx: Session, mission_id: str, epoch: int, now: float | None = None) -> bool:
    """Finalising → final, or sharpening.

    False while a frame or tile is on its way, or a photo came after the final solve. Raises LeaseLost unless
    `epoch` is the present owner's.
    """
    leases.guard(tx, mission_id, epoch)
    row = lock(tx, mission_id)
    now = clock(now)
    if row.state != "finalising":
        return False
    tiles.fuse_frames(tx, mission_id, now)
    has_frames = tx.scalar(select(exists().where(Frame.mission_id == mission_id, Frame.meta.is_not(None))))
    if (has_frames and row.final_generation is None) or tx.scalar(
        select(Mission.id).where(Mission.id == mission_id, _has_unfinished())
    ):
        return False
    if sharpening.wanted(row):
        row.state = "sharpening"
    else:
        row.state, row.finished_at = "final", now
    events.append(tx, mission_id, "mission", {"state": row.state, "revision": row.revision}, now)
    return True


def set_scale(tx: Session, mission_id: str, scale: KnownScale, now: float | None = None) -> bool:
    """Keep what is known of the scale; whether poses depend on it that were solved already.

    Then the mission is open again, or solves its final poses once more. Raises MissionNotFound.
    """
    row = lock(tx, mission_id)
    if row.scale == scale.to_json():
        return False
    row.scale = scale.to_json()
    tx.flush()
    return reopen_if_solved(tx, row, clock(now))


def reopen_if_solved(tx: Session, row: Mission, now: float) -> bool:
    """Open again a mission any of whose photos has had a pose: the final ones were solved from less."""
    posed = exists().where(Frame.mission_id == row.id, Frame.posed_at.is_not(None))
    if not tx.scalar(select(posed)):
        return False
    row.final_generation = None
    if row.state in ("final", "sharpening"):
        sharpening.undo(tx, row, now)
        row.state, row.finished_at = "open", None
        events.append(tx, row.id, "mission", {"state": "open"}, now)
    return True


def delete(tx: Session, mission_id: str, now: float | None = None) -> None:
    """Hide the mission from everybody at once; `purge` follows when its objects are gone."""
    row = lock(tx, mission_id)
    row.woken_at = clock(now)
    events.append(tx, mission_id, "mission", {"state": "deleting"}, now)
    row.state = "deleting"


def deleting(tx: Session) -> Sequence[str]:
    """The ids of the missions whose objects and rows are still to be removed."""
    return tx.scalars(select(Mission.id).where(Mission.state == "deleting").order_by(Mission.id)).all()


def purge(tx: Session, mission_id: str) -> None:
    """Remove every row of a deleted mission; nothing happens to one that was not deleted."""
    tx.execute(delete_rows(Mission).where(Mission.id == mission_id, Mission.state == "deleting"))


def spend(tx: Session, mission_id: str, stage: str, seconds: float) -> None:
    """Add to the seconds of work that a stage took, all workers together."""
    hold(tx, mission_id)
    spent = tx.execute(_SPENT, {"mission": mission_id}).scalar_one()
    spent = spent | {stage: spent.get(stage, 0.0) + seconds}
    tx.execute(_CHANGE, {"mission": mission_id, "stage_seconds": spent})
    in_step(tx, mission_id, stage_seconds=spent)


def count_pixels(tx: Session, mission_id: str, pixels: Mapping[str, int]) -> None:
    """Add to the pixels that were rendered: of new ground, to heal, by the final pass, to sharpen."""
    hold(tx, mission_id)
    so_far = tx.execute(_PIXELS, {"mission": mission_id}).scalar_one()
    more = {kind: so_far.get(kind, 0) + n for kind, n in pixels.items() if n}
    tx.execute(_CHANGE, {"mission": mission_id, "pixels": so_far | more})
    in_step(tx, mission_id, pixels=so_far | more)


def progress(tx: Session, mission_id: str, now: float | None = None) -> Progress:
    """How far the mission has come; raises MissionNotFound."""
    row = mission(tx, mission_id)
    counts = dict.fromkeys(frames.STATES, 0)
    for state, count in tx.execute(_BY_STATE, {"mission": mission_id}):
        counts[state] = count
    since = {"mission": mission_id, "since": clock(now) - _RATE_WINDOW_S}
    return Progress(
        mission_id=mission_id,
        state=row.state,
        frames=sum(counts.values()),
        counts=counts,
        revision=row.revision,
        generation=row.generation,
        tiles=tx.execute(_SHOWN, {"mission": mission_id}).scalar_one(),
        dirty=tiles.dirty_count(tx, mission_id),
        fused_per_s=tx.execute(_FUSED, since).scalar_one() / _RATE_WINDOW_S,
        event_seq=row.event_seq,
        first_upload_at=row.first_upload_at,
        last_tile_at=row.last_tile_at,
        finished_at=row.finished_at,
        sharpened=sharpening.share(tx, row),
    )


def stalled(tx: Session, older_than_s: float, now: float | None = None) -> Sequence[Wake]:
    """Whom to wake for missions with tiles to show, or to be finished, that stood still; stamped."""
    now = clock(now)
    rendered = exists().where(DirtyTile.mission_id == Mission.id, DirtyTile.rendered_generation.is_not(None))
    query = (
        select(Mission, rendered)
        .where(Mission.state.in_(_UNDER_WAY), func.coalesce(Mission.woken_at, 0.0) < now - older_than_s)
        .where(Mission.state.in_(_ENDING) | _has_tiles_to_show() | _is_behind())
        .order_by(Mission.id)
        .with_for_update(of=Mission, skip_locked=True)
        .execution_options(populate_existing=True)
    )
    wakes: Sequence[Wake] = []
    for row, has_rendered in tx.execute(query):
        row.woken_at = now
        publish = [Wake("publish", (row.id,))] if has_rendered else []
        wakes = [*wakes, *publish, Wake("sequence", (row.id,))]
    return wakes


def _has_tiles_to_show() -> ColumnElement[bool]:
    dirty = exists().where(DirtyTile.mission_id == Mission.id)
    return dirty | exists().where(Frame.mission_id == Mission.id, Frame.state == "posed")


def _is_behind() -> ColumnElement[bool]:
    """Poses were found since all tiles were drawn last: once no more photos come, they are drawn again."""
    return Mission.generation > func.coalesce(Mission.healed_generation, 0)


def _has_unfinished() -> ColumnElement[bool]:
    waiting = Frame.state.in_(("received", "ready", "matched"))
    return _has_tiles_to_show() | exists().where(Frame.mission_id == Mission.id, waiting)


def _has_work() -> ColumnElement[bool]:
    return Mission.state.in_(_ENDING) | _has_unfinished()
