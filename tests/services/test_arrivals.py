"""Frames that were read since somebody last asked: none is missed, none comes twice. On every backend."""

from __future__ import annotations

import random

from sqlalchemy import event

from core.frame import FrameMeta
from services.catalog import arrivals, frames
from services.catalog.arrivals import LATE_S
from services.database import Database


def read(db: Database, mission_id: str, name: str, at: float, looks: bytes | None = None) -> None:
    meta = FrameMeta(4000, 3000, drone=name)
    with db.write() as tx:
        frames.receive(tx, mission_id, name, f"{name}.jpg", 10, "image/jpeg", 4000, 3000, now=at)
        frames.mark_ready(tx, mission_id, name, meta, at, looks)


def since(db: Database, mission_id: str, at: float | None, known: str = "", wanted: str = "") -> set[str]:
    with db.read() as tx:
        found = arrivals.since(tx, mission_id, at, known, wanted)
    assert len(found) == len({f.frame_id for f in found})
    return {f.frame_id for f in found}


def test_a_frame_comes_as_it_was_read(db: Database, mission_id: str) -> None:
    read(db, mission_id, "a", 7.0, b"looks")
    read(db, mission_id, "b", 8.0)
    with db.read() as tx:
        first, second = sorted(arrivals.since(tx, mission_id, None, ()), key=lambda f: f.frame_id)
    assert (first.name, first.meta.drone, first.looks, first.ready_at) == ("a.jpg", "a", b"looks", 7.0)
    assert second.looks is None


def test_what_is_known_does_not_come_again_and_what_came_late_does(db: Database, mission_id: str) -> None:
    for at, name in enumerate("abcdef", 100):
        read(db, mission_id, name, float(at))
    assert since(db, mission_id, None) == set("abcdef")
    assert since(db, mission_id, 105.0, "f") == set("abcde")
    assert since(db, mission_id, 105.0, "bdf") == set("ace")
    read(db, mission_id, "late", 106.0 - LATE_S)
    assert "late" in since(db, mission_id, 106.0, "abcdef")
    read(db, mission_id, "too late", 105.0 - LATE_S)
    assert "too late" not in since(db, mission_id, 106.0)
    assert "too late" in since(db, mission_id, None)


def test_what_is_wanted_comes_however_old_it_is(db: Database, mission_id: str) -> None:
    for at, name in enumerate("abc"):
        read(db, mission_id, name, 100.0 * at)
    assert since(db, mission_id, 200.0, "c", "a") == {"a"}
    assert since(db, mission_id, 200.0, "ac", "a") == set()


def test_only_frames_that_can_be_used_come(db: Database, mission_id: str) -> None:
    for name in "abc":
        read(db, mission_id, name, 1.0)
    with db.write() as tx:
        frames.receive(tx, mission_id, "new", "new", 10, "image/jpeg", 4000, 3000, now=1.0)
        frames.mark_lost(tx, mission_id, "b")
        frames.mark_matched(tx, mission_id, "c")
        assert arrivals.is_ready(tx, mission_id, "a")
        assert not any(arrivals.is_ready(tx, mission_id, k) for k in ("new", "b", "c", "nobody"))
    assert since(db, mission_id, None, wanted="abc") == {"a", "c"}


def test_whoever_asks_now_and_then_gets_to_know_all_and_reads_each_once(
    db: Database, mission_id: str
) -> None:
    chance, names = random.Random(3), [f"{k:02d}" for k in range(40)]
    read_of: list[str] = []

    def note(_conn: object, _cursor: object, statement: str, parameters: object, *_: object) -> None:
        if "frames.meta" in statement.split("FROM")[0]:
            read_of.extend(name for name in names if repr(name) in repr(parameters))

    known: set[str] = set()
    newest: float | None = None
    with db.read() as tx:
        event.listen(tx.get_bind(), "before_cursor_execute", note)
    for k, name in enumerate(names):
        read(db, mission_id, name, 1000.0 + k + chance.uniform(-LATE_S / 2, LATE_S / 2))
        if chance.random() < 0.4 or k == 39:
            with db.read() as tx:
                for frame in arrivals.since(tx, mission_id, newest, known):
                    known.add(frame.frame_id)
                    newest = max(newest or 0.0, frame.ready_at)
    assert known == set(names)
    assert sorted(read_of) == names
