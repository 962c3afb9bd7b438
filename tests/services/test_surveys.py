"""Surveyed points belong to a mission; what is held by them is solved again when they change."""

from __future__ import annotations

import pytest

from core.checkpoints import parse_gcp_list
from core.frame import FrameMeta
from services.catalog import events, exports, frames, leases, missions, poses, surveys
from services.catalog.poses import PoseUpdate
from services.database import Database
from services.errors import MissionNotFound

GCP = "EPSG:32632\n500000 5200000 7 100 200 a.jpg P1\n500050 5200000 8 300 200 a.jpg P2\n"


@pytest.fixture
def final(db: Database, mission_id: str) -> str:
    """A mission that came to its end at 20, with its report made."""
    with db.write() as tx:
        frames.receive(tx, mission_id, "f", "a.jpg", 1, "image/jpeg", 400, 300, now=1.0)
        frames.mark_ready(tx, mission_id, "f", FrameMeta(400, 300), 2.0)
        frames.mark_matched(tx, mission_id, "f", 3.0)
        epoch = leases.acquire(tx, mission_id, "me", 3600.0)
        assert epoch is not None
        missions.request_finalise(tx, mission_id, 10.0)
        frames.mark_posed(tx, mission_id, ["f"], 11.0)
        frames.get(tx, mission_id, "f").state = "fused"
        poses.save(tx, mission_id, epoch, PoseUpdate(final=True), 11.0)
        assert missions.finish(tx, mission_id, epoch, 20.0)
        for name in ("report.json", "mosaic.tif"):
            exports.request(tx, mission_id, name, 30.0)
            exports.finish(tx, mission_id, name, 0, f"key/{name}", 1, "x/y", 31.0)
    return mission_id


def test_points_are_kept_as_they_were_sent_and_taken_back(db: Database, mission_id: str) -> None:
    with db.write() as tx:
        assert surveys.checkpoints(tx, mission_id) is None
        surveys.put(tx, mission_id, None, [])
        assert surveys.checkpoints(tx, mission_id) is None
        surveys.put(tx, mission_id, GCP, ["P2", "P1", "P2"])
        assert surveys.checkpoints(tx, mission_id) == parse_gcp_list(GCP).using(["P1", "P2"])
        surveys.put(tx, mission_id, GCP, [])
        assert surveys.checkpoints(tx, mission_id) == parse_gcp_list(GCP)
        surveys.put(tx, mission_id, None, [])
        assert surveys.checkpoints(tx, mission_id) is None
    with pytest.raises(MissionNotFound), db.write() as tx:
        surveys.put(tx, "nobody", GCP, [])


def test_points_that_only_check_move_nothing_and_renew_the_report_alone(db: Database, final: str) -> None:
    with db.write() as tx:
        assert not surveys.put(tx, final, GCP, [], 40.0)
        assert missions.get(tx, final).state == "final"
        assert exports.request(tx, final, "report.json", 41.0)[1]
        assert not exports.request(tx, final, "mosaic.tif", 41.0)[1]
        exports.finish(tx, final, "report.json", 0, "key", 1, "x/y", 42.0)
        assert not surveys.put(tx, final, GCP, [], 50.0)  # the same again: nothing new
        assert not exports.request(tx, final, "report.json", 51.0)[1]


@pytest.mark.parametrize("used", [["P1"], []])
def test_points_that_hold_the_map_open_a_final_mission(db: Database, final: str, used: list[str]) -> None:
    with db.write() as tx:
        surveys.put(tx, final, GCP, ["P2"], 5.0)
        assert missions.get(tx, final).state == "open"
        missions.get(tx, final).state = "final"
        assert not surveys.put(tx, final, GCP, ["P2"], 35.0)
        assert missions.get(tx, final).state == "final"
        assert surveys.put(tx, final, GCP, used, 40.0)
        row = missions.get(tx, final)
        told = [e.payload["state"] for e in events.since(tx, final, 0) if e.kind == "mission"]
    assert (row.state, row.finished_at, row.final_generation) == ("open", None, None)
    assert told[-1] == "open"


def test_points_that_come_while_a_mission_is_finished_are_solved_for(db: Database, mission_id: str) -> None:
    with db.write() as tx:
        frames.receive(tx, mission_id, "f", "a.jpg", 1, "image/jpeg", 400, 300, now=1.0)
        epoch = leases.acquire(tx, mission_id, "me", 3600.0)
        assert epoch is not None
        missions.request_finalise(tx, mission_id, 10.0)
        frames.mark_ready(tx, mission_id, "f", FrameMeta(400, 300), 2.0)
        frames.mark_matched(tx, mission_id, "f", 3.0)
        frames.mark_posed(tx, mission_id, ["f"], 11.0)
        poses.save(tx, mission_id, epoch, PoseUpdate(final=True), 11.0)
        assert surveys.put(tx, mission_id, GCP, ["P1"], 12.0)
        row = missions.get(tx, mission_id)
        assert (row.state, row.final_generation) == ("finalising", None)
        assert not missions.finish(tx, mission_id, epoch, 13.0)
