"""What it costs to look up a few tiles, or frames, does not depend on how many the mission has."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy.orm import Session

from core.frame import FrameMeta
from services.catalog import backlog, frames, missions, tiles
from services.catalog.tiles import Key, Render
from services.database import Database

ASKED = [(20, x, y) for x in (5, 6, 9) for y in (3, 4, 8)]
SMALL, LARGE = 12, 72


@pytest.fixture
def embedded(migrated_sqlite: Path, tmp_path: Path) -> Iterator[Database]:
    """SQLite, which counts its own steps."""
    shutil.copy(migrated_sqlite, tmp_path / "test.db")
    database = Database(f"sqlite:///{tmp_path / 'test.db'}")
    yield database
    database.close()


def steps(tx: Session, work: Callable[[Session], Any]) -> int:
    """How many steps of the database's machine some work takes, in tens."""
    counted = [0]

    def count() -> None:
        counted[0] += 1

    connection: Any = tx.connection().connection.dbapi_connection
    work(tx)  # what is looked up once only
    connection.set_progress_handler(count, 10)
    work(tx)
    connection.set_progress_handler(None, 0)
    return counted[0]


def tiled(db: Database, side: int) -> str:
    """A mission of side × side tiles, all shown once and dirty again."""
    keys: list[Key] = [(20, x, y) for x in range(side) for y in range(side)]
    with db.write() as tx:
        mission_id = missions.create(tx, "tiled", now=0.0).id
        shown = [Render(k, 1, f"{k}", f"{k}") for k in keys]
        tiles.mark_dirty(tx, mission_id, keys, 1)
        tiles.record_renders(tx, mission_id, shown)
        tiles.publish(tx, mission_id, 0, shown, shown, now=1.0)
        tiles.mark_dirty(tx, mission_id, keys, 2)
    return mission_id


@pytest.mark.parametrize(
    "work",
    [
        lambda tx, mission_id: tiles.current(tx, mission_id, ASKED),
        lambda tx, mission_id: backlog.unrendered(tx, mission_id, ASKED),
    ],
)
def test_tiles(embedded: Database, work: Callable[[Session, str], Any]) -> None:
    spent = []
    for mission_id in (tiled(embedded, SMALL), tiled(embedded, LARGE)):
        with embedded.read() as tx:
            assert sorted(work(tx, mission_id)) == ASKED
            spent.append(steps(tx, lambda tx, m=mission_id: work(tx, m)))  # type: ignore[misc]
    assert 0 < spent[1] < 2 * spent[0]


def test_whether_a_frame_is_news(embedded: Database) -> None:
    spent = []
    for size in (100, 3000):
        with embedded.write() as tx:
            mission_id = missions.create(tx, "many", now=0.0).id
            for k in range(size):
                frames.receive(tx, mission_id, f"{k:032x}", f"{k}", 1000, "image/jpeg", 640, 480, now=1.0)
            for k in range(3):
                frames.mark_ready(tx, mission_id, f"{k:032x}", FrameMeta(640, 480), now=2.0)
                frames.mark_matched(tx, mission_id, f"{k:032x}", now=3.0 + 0.01 * k)
        with embedded.read() as tx:
            spent.append(
                steps(tx, lambda tx, m=mission_id: backlog.is_news(tx, m, f"{2:032x}", 0.5, 4))  # type: ignore[misc]
            )
    assert spent[1] <= spent[0] + 2
