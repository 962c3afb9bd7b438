"""Viewers are told what became true, in its order; what stands still is woken."""

from __future__ import annotations

import time

import pytest

from services.catalog import events, leases, poses, tiles
from services.catalog.poses import PoseUpdate
from services.catalog.standstill import stalled
from services.catalog.wakes import Wake
from services.database import Database
from services.errors import MissionNotFound
from tests.services.mission_rows import Race, Z, dirty, render


class TestEvents:
    def test_numbers_are_dense_and_in_the_order_of_the_commits(
        self, db: Database, mission_id: str, race: Race
    ) -> None:
        """A reader that asks for what is new never sees a gap, and never misses what fills one later."""

        def work(i: int) -> list[int]:
            if i:
                for n in range(50):
                    with db.write() as tx:
                        events.append(tx, mission_id, "mission", {"writer": i, "n": n})
                return []
            seen: list[int] = []
            deadline = time.monotonic() + 60
            while len(seen) < 150 and time.monotonic() < deadline:
                with db.read() as tx:
                    seen += [e.seq for e in events.since(tx, mission_id, seen[-1] if seen else 0, limit=7)]
            return seen

        assert race(4, work)[0] == list(range(1, 151))

    def test_a_rolled_back_event_leaves_no_gap(self, db: Database, mission_id: str) -> None:
        def fail() -> None:
            with db.write() as tx:
                events.append(tx, mission_id, "mission", {})
                raise RuntimeError

        with pytest.raises(RuntimeError):
            fail()
        with db.write() as tx:
            assert events.append(tx, mission_id, "mission", {"x": 1}, now=3.0) == 1
        with db.read() as tx:
            (event,) = events.since(tx, mission_id, 0)
        assert (event.payload, event.at) == ({"x": 1}, 3.0)


class TestWakingMissions:
    def test_tiles_that_nobody_shows_wake_their_mission_once(
        self, db: Database, mission_id: str, owner: int
    ) -> None:
        with db.write() as tx:
            poses.save(tx, mission_id, owner, PoseUpdate(dirty=dirty(0)), now=100.0)
        with db.write() as tx:
            assert stalled(tx, 10.0, now=105.0) == []  # it moved lately
        with db.write() as tx:
            assert stalled(tx, 10.0, now=111.0) == [Wake("sequence", (mission_id,))]
            tiles.record_renders(tx, mission_id, [render((Z, 0, 0), 1)])
        with db.write() as tx:
            assert stalled(tx, 10.0, now=115.0) == []
            found = stalled(tx, 10.0, now=122.0)
        assert set(found) == {Wake("sequence", (mission_id,)), Wake("publish", (mission_id,))}

    def test_unknown_missions_cannot_be_locked(self, db: Database) -> None:
        for write in (
            lambda tx: leases.acquire(tx, "none", "a", 1.0),
            lambda tx: tiles.mark_dirty(tx, "none", [(Z, 0, 0)], 1),
            lambda tx: events.append(tx, "none", "mission", {}),
        ):
            with pytest.raises(MissionNotFound), db.write() as tx:
                write(tx)
