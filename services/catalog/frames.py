"""Frames: received → ready → matched → posed → fused, or rejected with a reason.

One that ties to nothing that has a place is waiting: it is kept, and posed when another photo ties it in.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from sqlalchemy import ColumnElement, and_, bindparam, func, or_, select, tuple_, update
from sqlalchemy.orm import InstrumentedAttribute, Session
from sqlalchemy.sql.dml import ReturningInsert

from core.errors import OrthostreamError, PhotoLost
from core.frame import FrameMeta
from services.catalog import events, sharpening
from services.catalog.rows import MISSION, chunks, clock, hold, insert_into, lock, table
from services.catalog.wakes import Wake
from services.errors import FrameNotFound
from services.tables import Frame, Mission

STATES = ("received", "ready", "matched", "posed", "fused", "waiting", "rejected")
WAITING, INTERNAL = "waiting", "internal"
NOT_ITS_FAULT = (INTERNAL, PhotoLost.code)
"""Why a photo was rejected that may be tried again when it is uploaded again."""
WHY_WAITING = (
    "The photo has no GPS and shows nothing yet that a photo on the map shows. It is kept, and goes onto the "
    "map as soon as another photo ties it in."
)
_WAKES_AT_ONCE = 200

_FRAME = table(Frame).c
_ONE = (_FRAME.mission_id == bindparam("mission")) & (_FRAME.id == bindparam("frame"))
_UPLOADED = select(_FRAME.state, _FRAME.reason_code, _FRAME.reason).where(
    _ONE, _FRAME.media_type.is_not(None)
)
_BEGIN = (
    update(table(Frame))
    .where(_ONE, _FRAME.state == "received")
    .values(attempts=_FRAME.attempts + 1)
    .returning(_FRAME.attempts, _FRAME.width, _FRAME.height, _FRAME.telemetry)
)
_FUSED = select(_FRAME.fused_at, _FRAME.received_at).where(
    _FRAME.mission_id == bindparam("mission"), _FRAME.fused_at.is_not(None)
)
_ADVANCE = update(table(Frame)).where(_ONE, _FRAME.state == bindparam("before")).returning(_FRAME.id)
_BEFORE_IT_CAME = select(MISSION.state, MISSION.first_upload_at, MISSION.final_generation).where(
    MISSION.id == bindparam("mission")
)


@dataclass(frozen=True, slots=True)
class Attempt:
    """At reading a photo: the how manieth it is, the photo's pixels, and what was sent along with it."""

    number: int
    width: int
    height: int
    telemetry: Mapping[str, Any] | None


@dataclass(frozen=True, slots=True)
class Upload:
    """A photo that is here, as whoever uploads it is told."""

    frame_id: str
    state: str
    code: str | None = None
    reason: str | None = None


@dataclass(frozen=True, slots=True)
class Seen:
    """A frame that was read: what neighbours are found by, besides its features."""

    frame_id: str
    name: str
    state: str
    meta: FrameMeta


def receive(
    tx: Session,
    mission_id: str,
    frame_id: str,
    name: str,
    size_bytes: int,
    media_type: str,
    width: int,
    height: int,
    telemetry: Mapping[str, Any] | None = None,
    now: float | None = None,
) -> tuple[Upload, bool]:
    """What is there now, and whether it is new. A new one opens a final mission again.

    Raises MissionNotFound. Put the photo's bytes into the store before this transaction commits.
    """
    hold(tx, mission_id)
    now = clock(now)
    created = _insert(
        tx,
        mission_id=mission_id,
        id=frame_id,
        name=_clean(name),
        size_bytes=size_bytes,
        media_type=media_type,
        width=width,
        height=height,
        state="received",
        telemetry=dict(telemetry) if telemetry else None,
        received_at=now,
        attempts=0,
    )
    if created:
        _reopen(tx, mission_id, now)
        events.append_frames(tx, mission_id, "received", [frame_id], now)
        return Upload(frame_id, "received"), True
    return _upload(get(tx, mission_id, frame_id)), False


def record_rejected_upload(
    tx: Session,
    mission_id: str,
    frame_id: str,
    name: str,
    size_bytes: int,
    error: OrthostreamError,
    now: float | None = None,
) -> Frame:
    """Remember an upload that was refused before it was stored, with the reason its uploader was told."""
    hold(tx, mission_id)
    now = clock(now)
    created = _insert(
        tx,
        mission_id=mission_id,
        id=frame_id,
        name=_clean(name),
        size_bytes=size_bytes,
        state="rejected",
        reason_code=error.code,
        reason=str(error),
        received_at=now,
        attempts=0,
    )
    if created:
        events.append_frames(tx, mission_id, "rejected", [frame_id], now, code=error.code)
    return get(tx, mission_id, frame_id)


def uploaded(tx: Session, mission_id: str, frame_id: str) -> Upload | None:
    """The photo if it is here already with its bytes; one that was refused at upload has none."""
    row = tx.execute(_UPLOADED, {"mission": mission_id, "frame": frame_id}).first()
    return None if row is None else Upload(frame_id, *row)


def begin(tx: Session, mission_id: str, frame_id: str) -> Attempt | None:
    """Count one more attempt at reading the photo; None when it was read already. Raises FrameNotFound.

    A photo that kills its reader is found again and again: whoever sees the number grow rejects it.
    """
    hold(tx, mission_id)
    row = tx.execute(_BEGIN, {"mission": mission_id, "frame": frame_id}).first()
    if row is None:
        get(tx, mission_id, frame_id)
    return None if row is None else Attempt(*row)


def forgive(tx: Session, mission_id: str, frame_id: str) -> None:
    """Forget the attempts at reading the photo: they ended for a reason that is not the photo's."""
    hold(tx, mission_id)
    row = (Frame.mission_id == mission_id) & (Frame.id == frame_id)
    tx.execute(update(Frame).where(row).values(attempts=0).execution_options(synchronize_session=False))


def mark_ready(
    tx: Session,
    mission_id: str,
    frame_id: str,
    meta: FrameMeta,
    now: float | None = None,
    looks: bytes | None = None,
) -> bool:
    """Received → ready with what was read. False, and nothing written, when it had come further already.

    `looks`: see `arrivals.Arrived`.
    """
    values = {"meta": meta.to_json(), "ready_at": clock(now), "looks": looks}
    return _advance(tx, mission_id, frame_id, "received", "ready", values, now)


def mark_matched(tx: Session, mission_id: str, frame_id: str, now: float | None = None) -> bool:
    """Ready → matched, in the transaction that records its last pairs. False when it was already."""
    return _advance(tx, mission_id, frame_id, "ready", "matched", {"matched_at": clock(now)}, now)


def mark_rejected(
    tx: Session, mission_id: str, frame_id: str, code: str, reason: str, now: float | None = None
) -> bool:
    """Received or ready → rejected, because the photo itself is no good. False when that was decided."""
    hold(tx, mission_id)
    now = clock(now)
    changed = _set(
        tx,
        mission_id,
        [frame_id],
        ("received", "ready"),
        {"state": "rejected", "reason_code": code, "reason": _clean(reason)},
    )
    events.append_frames(tx, mission_id, "rejected", changed, now, code=code)
    return bool(changed)


def mark_lost(tx: Session, mission_id: str, frame_id: str, now: float | None = None) -> bool:
    """Any state → rejected, because the photo's file is gone; it is no longer among `sightings`."""
    hold(tx, mission_id)
    lost = {"state": "rejected", "reason_code": PhotoLost.code, "reason": str(PhotoLost())}
    values = lost | {"matched_at": None, "island": None}
    changed = _set(tx, mission_id, [frame_id], tuple(s for s in STATES if s != "rejected"), values)
    events.append_frames(tx, mission_id, "rejected", changed, now, code=PhotoLost.code)
    return bool(changed)


def mark_posed(
    tx: Session, mission_id: str, frame_ids: Iterable[str], now: float | None = None
) -> Sequence[str]:
    """Matched → posed; so is one that could not be placed before. The ids that changed."""
    hold(tx, mission_id)
    now = clock(now)
    values = {"state": "posed", "posed_at": now, "reason_code": None, "reason": None, "island": None}
    changed = _set(tx, mission_id, sorted(frame_ids), ("matched", WAITING), values, or_unplaced=True)
    events.append_frames(tx, mission_id, "posed", changed, now)
    return changed


def mark_unplaced(
    tx: Session, mission_id: str, reasons: Mapping[str, tuple[str, str]], now: float | None = None
) -> Sequence[str]:
    """matched, posed, fused or waiting → rejected by the pose graph: {frame_id: (code, reason)}.

    The ids that changed.

    Such a frame stays among `sightings`: more photos may tie it in after all.
    """
    hold(tx, mission_id)
    now = clock(now)
    changed: Sequence[str] = []
    for code, reason in sorted(set(reasons.values())):
        ids = sorted(f for f, why in reasons.items() if why == (code, reason))
        values = {"state": "rejected", "reason_code": code, "reason": _clean(reason), "island": None}
        some = _set(tx, mission_id, ids, ("matched", "posed", "fused", WAITING), values)
        events.append_frames(tx, mission_id, "rejected", some, now, code=code)
        changed = [*changed, *some]
    return changed


def mark_waiting(
    tx: Session, mission_id: str, islands: Mapping[str, Mapping[str, Any] | None], now: float | None = None
) -> Sequence[str]:
    """matched, posed, fused or unplaced → waiting, each with its pose on its island. The ids that changed."""
    hold(tx, mission_id)
    values = {"state": WAITING, "reason_code": WAITING, "reason": WHY_WAITING}
    states = ("matched", "posed", "fused")
    changed = _set(tx, mission_id, sorted(islands), states, values, or_unplaced=True)
    for some in chunks(sorted(islands)):
        query = select(Frame).where(
            Frame.mission_id == mission_id, Frame.id.in_(some), Frame.state == WAITING
        )
        for row in tx.scalars(query.execution_options(populate_existing=True)):
            island = islands[row.id]
            row.island = None if island is None else dict(island)
    tx.flush()
    events.append_frames(tx, mission_id, WAITING, changed, clock(now))
    return changed


def retry(tx: Session, mission_id: str, frame_id: str, now: float | None = None) -> bool:
    """Rejected for a reason that was not the photo's → received. False when there is nothing to try again.

    A final mission is open again.
    """
    hold(tx, mission_id)
    row = get(tx, mission_id, frame_id)
    if row.state != "rejected" or row.reason_code not in NOT_ITS_FAULT:
        return False
    row.state, row.reason_code, row.reason, row.attempts, row.woken_at = "received", None, None, 0, None
    tx.flush()
    _reopen(tx, mission_id, clock(now))
    events.append_frames(tx, mission_id, "received", [frame_id], now)
    return True


def islands(tx: Session, mission_id: str) -> Mapping[str, Mapping[str, Any] | None]:
    """The frames that wait, by id, each with its pose on its island; None for one that is alone."""
    query = select(Frame.id, Frame.island).where(Frame.mission_id == mission_id, Frame.state == WAITING)
    return {row.id: row.island for row in tx.execute(query.order_by(Frame.id))}


def get(tx: Session, mission_id: str, frame_id: str) -> Frame:
    """The frame's row as it is now; raises FrameNotFound."""
    row = tx.get(Frame, (mission_id, frame_id), populate_existing=True)
    if row is None:
        raise FrameNotFound(f"Mission {mission_id!r} has no frame {frame_id!r}.")
    return row


def list(
    tx: Session, mission_id: str, state: str | None = None, limit: int = 1000, after: str | None = None
) -> Sequence[Frame]:
    """Frames in the order of their arrival, from the one after frame `after` on, at most `limit`."""
    query = select(Frame).where(Frame.mission_id == mission_id)
    if state is not None:
        query = query.where(Frame.state == state)
    if after is not None:
        last = get(tx, mission_id, after)
        query = query.where(tuple_(Frame.received_at, Frame.id) > tuple_(last.received_at, last.id))
    return tx.scalars(query.order_by(Frame.received_at, Frame.id).limit(limit)).all()


def sightings(tx: Session, mission_id: str) -> Sequence[Seen]:
    """Every frame that could be read, by id: also those that the pose graph could not place yet."""
    query = (
        select(Frame.id, Frame.name, Frame.state, Frame.meta)
        .where(Frame.mission_id == mission_id, Frame.meta.is_not(None))
        .where(or_(Frame.state != "rejected", Frame.matched_at.is_not(None)))
        .order_by(Frame.id)
    )
    return [Seen(i, name, state, FrameMeta.from_json(m or {})) for i, name, state, m in tx.execute(query)]


def latencies_s(tx: Session, mission_id: str) -> Sequence[float]:
    """Seconds from upload to visible tile of every fused frame, in no order."""
    return [fused - received for fused, received in tx.execute(_FUSED, {"mission": mission_id})]


def quiet_s(tx: Session, mission_id: str, now: float | None = None) -> float:
    """Seconds since the last photo came; inf when none ever did."""
    newest = tx.scalar(select(func.max(Frame.received_at)).where(Frame.mission_id == mission_id))
    return math.inf if newest is None else clock(now) - newest


def stalled(tx: Session, older_than_s: float, now: float | None = None) -> Sequence[Wake]:
    """Whom to wake for the frames that stood still, stamped so that nobody else wakes them as well."""
    now = clock(now)
    stages = (
        ("received", "ingest", Frame.received_at, Frame.ready_at),
        ("ready", "match", Frame.ready_at, Frame.matched_at),
    )
    wakes = [
        Wake(task, key)
        for state, task, entered, left in stages
        for key in _overdue(tx, state, entered, left, older_than_s, now)
    ]
    waiting = _overdue(tx, "matched", Frame.matched_at, None, older_than_s, now)
    return [*wakes, *(Wake("sequence", (mission_id,)) for mission_id in sorted({m for m, _ in waiting}))]


def _overdue(
    tx: Session,
    state: str,
    entered: InstrumentedAttribute[Any],
    left: InstrumentedAttribute[Any] | None,
    older_than_s: float,
    now: float,
) -> Sequence[tuple[str, str]]:
    """Frames in `state` whose wake-up was lost, oldest first; stamped.

    A long queue is no loss: while the stage moves at all, only those count that later ones have overtaken.
    """
    before = cutoff = now - older_than_s
    if left is not None:
        newest = tx.scalar(select(func.max(entered)).where(left >= cutoff))
        before = cutoff if newest is None else min(cutoff, newest - older_than_s)
    query = (
        select(Frame.mission_id, Frame.id)
        .join(Mission, Mission.id == Frame.mission_id)
        .where(Frame.state == state, entered < before, Mission.state != "deleting")
        .where(func.coalesce(Frame.woken_at, 0.0) < cutoff)
        .order_by(entered, Frame.id)
        .limit(_WAKES_AT_ONCE)
        .with_for_update(of=Frame, skip_locked=True)
    )
    keys = [(mission_id, frame_id) for mission_id, frame_id in tx.execute(query)]
    for some in chunks(keys):
        stamp = update(Frame).where(tuple_(Frame.mission_id, Frame.id).in_(some)).values(woken_at=now)
        tx.execute(stamp.execution_options(synchronize_session=False))
    return keys


def _insert(tx: Session, **values: Any) -> bool:
    return tx.execute(_insert_into(tx.get_bind().dialect.name), values).first() is not None


@lru_cache
def _insert_into(dialect: str) -> ReturningInsert[tuple[str]]:
    return insert_into(dialect, Frame).on_conflict_do_nothing().returning(_FRAME.id)


def _upload(row: Frame) -> Upload:
    return Upload(row.id, row.state, row.reason_code, row.reason)


def _reopen(tx: Session, mission_id: str, now: float) -> None:
    state, first_upload_at, final_generation = tx.execute(_BEFORE_IT_CAME, {"mission": mission_id}).one()
    if state not in ("final", "sharpening") and first_upload_at and final_generation is None:
        return  # as with nearly every photo
    mission = lock(tx, mission_id)
    mission.first_upload_at = mission.first_upload_at or now
    mission.final_generation = None  # what was solved as final lacks this frame
    if mission.state in ("final", "sharpening"):
        sharpening.undo(tx, mission, now)
        mission.state = "open"
        mission.finished_at = None
        events.append(tx, mission.id, "mission", {"state": "open"}, now)


def _advance(
    tx: Session,
    mission_id: str,
    frame_id: str,
    before: str,
    after: str,
    values: dict[str, Any],
    now: float | None,
) -> bool:
    hold(tx, mission_id)
    which = {"mission": mission_id, "frame": frame_id, "before": before}
    if tx.execute(_ADVANCE, {**which, "state": after, **values}).first() is None:
        get(tx, mission_id, frame_id)  # FrameNotFound for one that never was
        return False
    events.append_frames(tx, mission_id, after, [frame_id], now)
    return True


def _set(
    tx: Session,
    mission_id: str,
    ids: Sequence[str],
    states: tuple[str, ...],
    values: dict[str, Any],
    or_unplaced: bool = False,
) -> Sequence[str]:
    allowed: ColumnElement[bool] = Frame.state.in_(states)
    if or_unplaced:
        allowed = or_(allowed, and_(Frame.state == "rejected", Frame.matched_at.is_not(None)))
    changed: Sequence[str] = []
    for some in chunks(ids):
        statement = (
            update(Frame)
            .where(Frame.mission_id == mission_id, Frame.id.in_(some), allowed)
            .values(values)
            .returning(Frame.id)
            .execution_options(synchronize_session=False)
        )
        changed = [*changed, *tx.scalars(statement)]
    return changed


def _clean(text: str) -> str:
    """Postgres refuses NUL, UTF-8 refuses lone surrogates; a file's name can hold both."""
    return text.replace("\x00", "").encode("utf-8", "replace").decode("utf-8")
