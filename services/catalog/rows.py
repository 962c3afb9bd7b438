"""What all of the catalog leans on: the locked mission row and bulk inserts for both backends."""

from __future__ import annotations

import time
from collections.abc import Collection, Iterator, Sequence
from itertools import islice
from typing import TypeVar, cast

from sqlalchemy import Table, inspect
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.orm import Session

from services.errors import MissionNotFound
from services.tables import Base, Mission

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


def table(model: type[Base]) -> Table:
    """The Core table of a model, for bulk statements that need no objects."""
    return cast(Table, inspect(model).local_table)


def insert(tx: Session, model: type[Base]) -> postgresql.Insert:
    """An INSERT that knows ON CONFLICT; both dialects spell it alike, so it is typed as one of them."""
    if tx.get_bind().dialect.name == "sqlite":
        return cast(postgresql.Insert, sqlite.insert(table(model)))
    return postgresql.insert(table(model))


def chunks(items: Collection[T]) -> Iterator[Sequence[T]]:
    """`items` in lists short enough for one statement."""
    rest = iter(items)
    while chunk := list(islice(rest, CHUNK)):
        yield chunk
