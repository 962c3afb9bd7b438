"""What all of the catalog leans on: the locked mission row and bulk inserts for both backends."""

from __future__ import annotations

import time
from collections.abc import Collection, Iterator, Sequence
from functools import lru_cache
from itertools import islice
from typing import Any, TypeVar, cast

from sqlalchemy import ColumnElement, Table, and_, bindparam, inspect, select, tuple_
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.orm import Session
from sqlalchemy.orm.attributes import set_committed_value

from services.errors import MissionNotFound
from services.tables import Base, DirtyTile, Mission, Tile

T = TypeVar("T")

# SQLite takes 32,766 variables a statement; this leaves room for rows of a few dozen columns.
CHUNK = 500


def clock(now: float | None) -> float:
    """`now`, or what the clock says when it is None. Look at it after `lock`, which may wait."""
    return time.time() if now is None else now


def mission(tx: Session, mission_id: str) -> Mission:
    """The mission's row; MissionNotFound when there is none or it is being deleted."""
    row = tx.get(Mission, mission_id)
    if row is None or row.state == "deleting":
        raise MissionNotFound(f"There is no mission {mission_id!r}.")
    return row


def lock(tx: Session, mission_id: str) -> Mission:
    """The mission's row, held until this transaction ends; MissionNotFound as in `mission`."""
    held: dict[str, Mission] = tx.info.setdefault("locked_missions", {})
    if mission_id not in held:
        row = tx.get(Mission, mission_id, with_for_update=True, populate_existing=True)
        if row is None:
            raise MissionNotFound(f"There is no mission {mission_id!r}.")
        held[mission_id] = row
    if held[mission_id].state == "deleting":
        raise MissionNotFound(f"The mission {mission_id!r} was deleted.")
    return held[mission_id]


def hold(tx: Session, mission_id: str) -> None:
    """As `lock`, for those who need nothing of the row but that nobody else writes to its mission."""
    held: set[str] = tx.info.setdefault("held_missions", set())
    if mission_id in tx.info.get("locked_missions", ()):
        lock(tx, mission_id)
    elif mission_id not in held:
        state = tx.execute(_STATE, {"id": mission_id}).scalar()
        if state is None:
            raise MissionNotFound(f"There is no mission {mission_id!r}.")
        if state == "deleting":
            raise MissionNotFound(f"The mission {mission_id!r} was deleted.")
        held.add(mission_id)


def in_step(tx: Session, mission_id: str, **values: Any) -> None:
    """Tells the mission's object, if this transaction has one, what was written past it."""
    row = tx.identity_map.get(inspect(Mission).identity_key_from_primary_key((mission_id,)))
    for name, value in values.items() if row is not None else ():
        set_committed_value(row, name, value)


def table(model: type[Base]) -> Table:
    """The Core table of a model, for statements that need no objects."""
    return cast(Table, inspect(model).local_table)


# What every photo passes is said once and compiled once: objects and fresh statements take several times as
# long as the database itself.
MISSION = table(Mission).c
_STATE = select(MISSION.state).where(MISSION.id == bindparam("id")).with_for_update()


@lru_cache
def insert_into(dialect: str, model: type[Base]) -> postgresql.Insert:
    """An INSERT that knows ON CONFLICT; both dialects spell it alike, so it is typed as one of them."""
    if dialect == "sqlite":
        return cast(postgresql.Insert, sqlite.insert(table(model)))
    return postgresql.insert(table(model))


def insert(tx: Session, model: type[Base]) -> postgresql.Insert:
    """An INSERT that knows ON CONFLICT, in the words of this transaction's database."""
    return insert_into(tx.get_bind().dialect.name, model)


def among(of: type[Tile | DirtyTile], keys: Collection[tuple[int, int, int]]) -> ColumnElement[bool]:
    """Whether a row of a mission's is one of these tiles.

    SQLite finds one tuple by its index; for several it would read all tiles of the mission, so that it is
    told where they lie.
    """
    zs, xs, ys = (set(column) for column in zip(*keys, strict=True))
    near = and_(of.z.in_(sorted(zs)), of.x.in_(sorted(xs)), of.y.between(min(ys), max(ys)))
    return and_(near, tuple_(of.z, of.x, of.y).in_(sorted(keys)))


def chunks(items: Collection[T]) -> Iterator[Sequence[T]]:
    """`items` in lists short enough for one statement."""
    rest = iter(items)
    while chunk := list(islice(rest, CHUNK)):
        yield chunk
