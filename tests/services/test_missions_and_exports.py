"""Missions are opened, finished once everything is, opened again, deleted; exports follow the map."""

from __future__ import annotations

from typing import Any

import pytest
from sqlalchemy import func, select

from core.frame import FrameMeta
from services.catalog import events, exports, frames, leases, missions, poses, tiles
from services.catalog.poses import PoseUpdate
from services.catalog.standstill import stalled
from services.catalog.tiles import Render
from services.catalog.wakes import Wake
from services.database import Database
from services.errors import MissionNotFound
from services.tables import Base, Mission

KEY = (18, 0, 0)


@pytest.fixture
def epoch(db: Database, mission_id: str) -> int:
    with db.write() as tx:
        found = leases.acquire(tx, mission_id, "me", 3600.0)
    assert found is not None
    return found


def upload(tx: Any, mission_id: str, frame_id: str, now: float = 1.0) -> None:
    frames.receive(tx, mission_id, frame_id, frame_id, 1, "image/jpeg", 4000, 3000, now=now)


def read_and_match(tx: Any, mission_id: str, frame_id: str) -> None:
    frames.mark_ready(tx, mission_id, frame_id, FrameMeta(4000, 3000), 2.0)
    frames.mark_matched(tx, mission_id, frame_id, 3.0)


def finalise(db: Database, mission_id: str, epoch: int, now: float = 10.0) -> None:
    with db.write() as tx:
        missions.request_finalise(tx, mission_id, now)
        poses.save(tx, mission_id, epoch, PoseUpdate(unplaced={"f": ("oblique", "x")}, final=True), now)
        assert missions.finish(tx, mission_id, epoch, now)


class TestMissions:
    def test_ids_are_short_safe_and_different(self, db: Database) -> None:
        with db.write() as tx:
            ids = {missions.create(tx, f"m{i}").id for i in range(50)}
        assert len(ids) == 50
        assert all(len(i) == 10 and i.isalnum() and i == i.lower() for i in ids)

    def test_pages_go_from_new_to_old(self, db: Database) -> None:
        with db.write() as tx:
            ids = [missions.create(tx, f"m{i}", now=float(i // 2)).id for i in range(5)]
        seen: list[Mission] = []
        with db.read() as tx:
            while page := missions.list(tx, limit=2, after=seen[-1].id if seen else None):
                seen += page
        assert {m.id for m in seen} == set(ids)
        assert [m.created_at for m in seen] == [2.0, 1.0, 1.0, 0.0, 0.0]

    def test_it_is_final_only_when_everything_is_done(
        self, db: Database, mission_id: str, epoch: int
    ) -> None:
        with db.write() as tx:
            upload(tx, mission_id, "f")
            assert not missions.finish(tx, mission_id, epoch)  # nobody asked for it
            assert missions.request_finalise(tx, mission_id).state == "finalising"
            assert not missions.finish(tx, mission_id, epoch)  # a frame is on its way
            read_and_match(tx, mission_id, "f")
            assert not missions.finish(tx, mission_id, epoch)
            change = PoseUpdate(unplaced={"f": ("oblique", "x")}, dirty={KEY: 0})
            poses.save(tx, mission_id, epoch, change)
            renders = [Render(KEY, 1)]
            assert not missions.finish(tx, mission_id, epoch)  # a tile is dirty
            tiles.record_renders(tx, mission_id, renders)
            tiles.publish(tx, mission_id, 0, renders, renders)
            assert not missions.finish(tx, mission_id, epoch)  # that was not the final solve
            poses.save(tx, mission_id, epoch, PoseUpdate(final=True))
            assert missions.finish(tx, mission_id, epoch, now=50.0)
            row = missions.get(tx, mission_id)
            told = [e.payload["state"] for e in events.since(tx, mission_id, 0) if e.kind == "mission"]
        assert (row.state, row.finished_at, row.final_generation) == ("final", 50.0, 2)
        assert told == ["finalising", "final"]

    def test_an_empty_mission_can_be_final(self, db: Database, mission_id: str, epoch: int) -> None:
        with db.write() as tx:
            missions.request_finalise(tx, mission_id)
            assert missions.finish(tx, mission_id, epoch)

    def test_a_photo_after_the_end_opens_it_again(self, db: Database, mission_id: str, epoch: int) -> None:
        with db.write() as tx:
            upload(tx, mission_id, "f")
            read_and_match(tx, mission_id, "f")
        finalise(db, mission_id, epoch)
        with db.write() as tx:
            upload(tx, mission_id, "f")  # the same photo: nothing new
            assert missions.get(tx, mission_id).state == "final"
            upload(tx, mission_id, "g")
            row = missions.get(tx, mission_id)
        assert (row.state, row.final_generation, row.finished_at) == ("open", None, None)

    def test_a_photo_while_it_is_finished_makes_it_solve_again(
        self, db: Database, mission_id: str, epoch: int
    ) -> None:
        with db.write() as tx:
            upload(tx, mission_id, "f")
            read_and_match(tx, mission_id, "f")
            missions.request_finalise(tx, mission_id)
            change = PoseUpdate(unplaced={"f": ("oblique", "x")}, final=True)
            poses.save(tx, mission_id, epoch, change)
            upload(tx, mission_id, "g")
            read_and_match(tx, mission_id, "g")
            poses.save(tx, mission_id, epoch, PoseUpdate(unplaced={"g": ("oblique", "x")}))
            assert not missions.finish(tx, mission_id, epoch)
            assert missions.get(tx, mission_id).final_generation is None

    def test_asking_twice_is_asking_once(self, db: Database, mission_id: str, epoch: int) -> None:
        with db.write() as tx:
            missions.request_finalise(tx, mission_id)
            poses.save(tx, mission_id, epoch, PoseUpdate(final=True))
            assert missions.request_finalise(tx, mission_id).final_generation == 1
            assert missions.finish(tx, mission_id, epoch)
            assert missions.request_finalise(tx, mission_id).state == "final"

    def test_a_finalising_mission_that_stands_still_is_woken(self, db: Database, mission_id: str) -> None:
        with db.write() as tx:
            missions.request_finalise(tx, mission_id, now=100.0)
            assert stalled(tx, 10.0, now=105.0) == []
            assert stalled(tx, 10.0, now=111.0) == [Wake("sequence", (mission_id,))]

    def test_active_are_those_with_work_left(self, db: Database, mission_id: str, epoch: int) -> None:
        with db.write() as tx:
            assert missions.active(tx) == []
            upload(tx, mission_id, "f")
            assert [m.id for m in missions.active(tx)] == [mission_id]
            read_and_match(tx, mission_id, "f")
        finalise(db, mission_id, epoch)
        with db.read() as tx:
            assert missions.active(tx) == []

    def test_deleted_is_gone_at_once_and_its_rows_on_purge(
        self, db: Database, mission_id: str, epoch: int
    ) -> None:
        with db.write() as tx:
            upload(tx, mission_id, "f")
            tiles.mark_dirty(tx, mission_id, [KEY], 1)
            missions.purge(tx, mission_id)  # not deleted: stays
            assert missions.get(tx, mission_id).id == mission_id
            missions.delete(tx, mission_id)
        with db.read() as tx:
            assert missions.list(tx) == []
            assert missions.deleting(tx) == [mission_id]
            with pytest.raises(MissionNotFound):
                missions.get(tx, mission_id)
        with pytest.raises(MissionNotFound), db.write() as tx:
            upload(tx, mission_id, "g")
        with db.write() as tx:
            missions.purge(tx, mission_id)
        with db.read() as tx:
            counts = {
                t.name: tx.scalar(select(func.count()).select_from(t)) for t in Base.metadata.sorted_tables
            }
        assert set(counts.values()) == {0}

    def test_progress_counts_everything(self, db: Database, mission_id: str, epoch: int) -> None:
        with db.write() as tx:
            for frame_id in ("f", "g", "h"):
                upload(tx, mission_id, frame_id, now=7.0)
            frames.mark_rejected(tx, mission_id, "h", "truncated_image", "x")
            read_and_match(tx, mission_id, "f")
            tiles.mark_dirty(tx, mission_id, [KEY, (18, 1, 0)], 1)
            shown = [Render(KEY, 1, "key", "etag", "image/jpeg", 9)]
            tiles.publish(tx, mission_id, 0, shown, shown, now=9.0)
        with db.read() as tx:
            progress = missions.progress(tx, mission_id)
        assert progress.counts == {
            "received": 1,
            "ready": 0,
            "matched": 1,
            "posed": 0,
            "fused": 0,
            "waiting": 0,
            "rejected": 1,
        }
        assert (progress.frames, progress.revision, progress.tiles, progress.dirty) == (3, 1, 1, 1)
        assert (progress.first_upload_at, progress.last_tile_at, progress.idle) == (7.0, 9.0, False)

    def test_seconds_of_work_add_up(self, db: Database, mission_id: str) -> None:
        for seconds in (0.5, 0.25):
            with db.write() as tx:
                missions.spend(tx, mission_id, "ingest", seconds)
                missions.spend(tx, mission_id, "match", 1.0)
        with db.read() as tx:
            assert missions.get(tx, mission_id).stage_seconds == {"ingest": 0.75, "match": 2.0}


class TestExports:
    def test_it_is_made_once_and_kept_while_the_map_stands(
        self, db: Database, mission_id: str, epoch: int
    ) -> None:
        with db.write() as tx:
            export, wanted = exports.request(tx, mission_id, "mosaic.tif", now=5.0)
            assert (export.state, wanted) == ("wanted", True)
            assert exports.request(tx, mission_id, "mosaic.tif", now=6.0)[1] is False
            assert exports.finish(
                tx, mission_id, "mosaic.tif", 0, "key", 5_000_000_000, "image/tiff", now=7.0
            )
            export, wanted = exports.request(tx, mission_id, "mosaic.tif", now=8.0)
            assert (export.state, export.size_bytes, wanted) == ("ready", 5_000_000_000, False)
            poses.save(tx, mission_id, epoch, PoseUpdate(zoom=3))
            export, wanted = exports.request(tx, mission_id, "mosaic.tif", now=9.0)
            assert (export.state, export.generation, wanted) == ("wanted", 1, True)
            assert [e.name for e in exports.list(tx, mission_id)] == ["mosaic.tif"]
            assert exports.get(tx, mission_id, "poses.json") is None

    def test_a_new_photo_or_the_missions_end_makes_it_old(
        self, db: Database, mission_id: str, epoch: int
    ) -> None:
        def made(tx: Any, now: float) -> bool:
            _, wanted = exports.request(tx, mission_id, "report.json", now=now)
            revision = missions.get(tx, mission_id).revision
            exports.finish(tx, mission_id, "report.json", revision, "key", 1, "application/json", now=now)
            return wanted

        with db.write() as tx:
            assert made(tx, 5.0)
            assert not made(tx, 6.0)
            upload(tx, mission_id, "f", now=7.0)
            assert made(tx, 8.0)
            read_and_match(tx, mission_id, "f")
        finalise(db, mission_id, epoch, now=20.0)
        with db.write() as tx:
            assert made(tx, 21.0)
            assert not made(tx, 22.0)

    def test_a_result_of_an_older_revision_is_not_taken(self, db: Database, mission_id: str) -> None:
        with db.write() as tx:
            exports.request(tx, mission_id, "mosaic.tif")
            assert not exports.finish(tx, mission_id, "mosaic.tif", 7, "key", 1, "image/tiff")
            assert not exports.finish(tx, mission_id, "never.asked", 0, "key", 1, "image/tiff")
            export = exports.get(tx, mission_id, "mosaic.tif")
        assert export is not None
        assert export.state == "wanted"

    def test_a_failure_says_why_and_can_be_tried_again(self, db: Database, mission_id: str) -> None:
        with db.write() as tx:
            exports.request(tx, mission_id, "mosaic.tif")
            assert exports.fail(tx, mission_id, "mosaic.tif", 0, "No photo could be placed.")
            export = exports.get(tx, mission_id, "mosaic.tif")
            assert export is not None
            assert (export.state, export.error) == ("failed", "No photo could be placed.")
            again, wanted = exports.request(tx, mission_id, "mosaic.tif")
        assert (again.state, again.error, wanted) == ("wanted", None, True)

    def test_one_that_stands_still_is_woken(self, db: Database, mission_id: str) -> None:
        with db.write() as tx:
            exports.request(tx, mission_id, "mosaic.tif", now=100.0)
            assert stalled(tx, 10.0, now=105.0) == []
            assert stalled(tx, 10.0, now=111.0) == [Wake("export", (mission_id, "mosaic.tif"))]
            assert stalled(tx, 10.0, now=112.0) == []
