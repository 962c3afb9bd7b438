"""Exports: files made from the map once somebody asks for them."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import func, select, tuple_, update
from sqlalchemy.orm import Session

from services.catalog import events
from services.catalog.rows import clock, hold, lock
from services.catalog.wakes import Wake
from services.tables import Export, Frame, Mission, Survey


def request(tx: Session, mission_id: str, name: str, now: float | None = None) -> tuple[Export, bool]:
    """The export, and whether it has to be made now: it is new, failed before, or the map has moved on.

    While it is being made (`wanted`) a second request changes nothing.
    """
    mission = lock(tx, mission_id)
    now = clock(now)
    export = get(tx, mission_id, name)
    if export is not None and _is_good(tx, mission, export):
        return export, False
    if export is None:
        export = Export(mission_id=mission_id, name=name)
        tx.add(export)
    export.revision, export.generation, export.state = mission.revision, mission.generation, "wanted"
    export.requested_at = export.woken_at = now
    export.error = export.finished_at = None
    tx.flush()
    return export, True


def finish(
    tx: Session,
    mission_id: str,
    name: str,
    revision: int,
    object_key: str,
    size_bytes: int,
    media_type: str,
    now: float | None = None,
) -> bool:
    """Wanted → ready. False when it was asked for again meanwhile, of a newer revision."""
    return _end(
        tx, mission_id, name, revision, now, state="ready", object_key=object_key, size_bytes=size_bytes,
        media_type=media_type,
    )  # fmt: skip


def fail(
    tx: Session, mission_id: str, name: str, revision: int, error: str, now: float | None = None
) -> bool:
    """Wanted → failed with a sentence. False when it was asked for again meanwhile, of a newer revision."""
    return _end(tx, mission_id, name, revision, now, state="failed", error=error)


def get(tx: Session, mission_id: str, name: str) -> Export | None:
    """The export's row as it is now, or None when nobody asked for it."""
    return tx.get(Export, (mission_id, name), populate_existing=True)


def list(tx: Session, mission_id: str) -> Sequence[Export]:
    """Every export that was ever asked for, by name."""
    return tx.scalars(select(Export).where(Export.mission_id == mission_id).order_by(Export.name)).all()


def stalled(tx: Session, older_than_s: float, now: float | None = None) -> Sequence[Wake]:
    """Exports wanted for so long that their wake-up must have been lost; stamped."""
    now = clock(now)
    query = (
        select(Export.mission_id, Export.name)
        .join(Mission, Mission.id == Export.mission_id)
        .where(Export.state == "wanted", Mission.state != "deleting")
        .where(func.coalesce(Export.woken_at, Export.requested_at) < now - older_than_s)
        .order_by(Export.mission_id, Export.name)
        .with_for_update(of=Export, skip_locked=True)
    )
    found = [(mission_id, name) for mission_id, name in tx.execute(query)]
    if found:
        which = tuple_(Export.mission_id, Export.name).in_(found)
        stamp = update(Export).where(which).values(woken_at=now)
        tx.execute(stamp.execution_options(synchronize_session=False))
    return [Wake("export", key) for key in found]


def _is_good(tx: Session, mission: Mission, export: Export) -> bool:
    if export.state == "wanted":
        return True
    if export.state == "failed":
        return False
    if (export.revision, export.generation) != (mission.revision, mission.generation):
        return False
    # The report tells of rejected photos and of the mission's end, which change no pose and no tile.
    if mission.finished_at is not None and mission.finished_at > export.requested_at:
        return False
    survey = tx.get(Survey, mission.id, populate_existing=True)
    if export.name == "report.json" and survey is not None and survey.changed_at > export.requested_at:
        return False
    newest = tx.scalar(select(func.max(Frame.received_at)).where(Frame.mission_id == mission.id))
    return newest is None or newest <= export.requested_at


def _end(
    tx: Session, mission_id: str, name: str, revision: int, now: float | None, **values: str | int
) -> bool:
    hold(tx, mission_id)
    now = clock(now)
    export = get(tx, mission_id, name)
    if export is None or export.state != "wanted" or export.revision != revision:
        return False
    for column, value in values.items():
        setattr(export, column, value)
    export.finished_at = now
    events.append(tx, mission_id, "export", {"name": name, "state": export.state}, now)
    return True
