"""One owner writes poses; nothing that comes late overwrites anything newer."""

from __future__ import annotations

import time

import numpy as np
import pytest

from core.geometry import PosedFrame, World
from services.catalog import leases, missions, poses
from services.catalog.poses import PoseUpdate
from services.catalog.tiles import TileBox
from services.database import Database
from services.errors import LeaseLost
from tests.services.mission_rows import CAMERA, Race, Z, dirty, dirty_keys, placed, save, states


class TestLeases:
    def test_only_one_of_many_gets_it(self, db: Database, mission_id: str, race: Race) -> None:
        def grab(i: int) -> int | None:
            with db.write() as tx:
                return leases.acquire(tx, mission_id, f"owner {i}", 3600.0)

        assert sorted(e for e in race(6, grab) if e is not None) == [1]

    def test_epochs_rise_with_every_owner(self, db: Database, mission_id: str) -> None:
        with db.write() as tx:
            assert leases.acquire(tx, mission_id, "a", 10.0, now=0.0) == 1
            assert leases.acquire(tx, mission_id, "b", 10.0, now=9.0) is None
            assert leases.acquire(tx, mission_id, "a", 10.0, now=9.0) is None
            assert leases.acquire(tx, mission_id, "b", 10.0, now=10.5) == 2
            assert not leases.renew(tx, mission_id, "a", 1, 10.0, now=11.0)
            assert leases.renew(tx, mission_id, "b", 2, 10.0, now=20.0)
            assert leases.acquire(tx, mission_id, "c", 10.0, now=29.0) is None
            leases.release(tx, mission_id, "a", 1)  # not its own any more
            assert leases.acquire(tx, mission_id, "c", 10.0, now=29.0) is None
            leases.release(tx, mission_id, "b", 2)
            assert leases.acquire(tx, mission_id, "c", 10.0, now=29.0) == 3

    def test_an_expired_lease_holds_until_somebody_takes_it(self, db: Database, mission_id: str) -> None:
        with db.write() as tx:
            epoch = leases.acquire(tx, mission_id, "a", 1.0, now=0.0)
            assert epoch == 1
            leases.guard(tx, mission_id, epoch)
            assert leases.renew(tx, mission_id, "a", epoch, 10.0, now=100.0)
            leases.release(tx, mission_id, "a", epoch)
            with pytest.raises(LeaseLost):
                leases.guard(tx, mission_id, epoch)

    def test_a_paused_owner_that_wakes_up_late_writes_nothing(
        self, db: Database, mission_id: str, matched: list[str]
    ) -> None:
        with db.write() as tx:
            old = leases.acquire(tx, mission_id, "a", 1.0, now=0.0)
            new = leases.acquire(tx, mission_id, "b", 1.0, now=5.0)
        assert old is not None
        assert new is not None
        save(db, mission_id, new, PoseUpdate(placed=[placed("f0", east_m=7.0)], dirty=dirty(0), zoom=Z))
        late = PoseUpdate(
            placed=[placed("f0"), placed("f1")], unplaced={"f2": ("oblique", "x")}, dirty=dirty(9), zoom=11
        )
        with pytest.raises(LeaseLost):
            save(db, mission_id, old, late)
        with pytest.raises(LeaseLost), db.write() as tx:
            missions.finish(tx, mission_id, old)
        with db.read() as tx:
            now = poses.load(tx, mission_id)
        assert (now.generation, now.zoom, list(now.placed)) == (1, Z, ["f0"])
        assert now.placed["f0"].pose.center[0] == 7.0
        assert dirty_keys(db, mission_id) == set(dirty(0))
        assert states(db, mission_id) == {"f0": "posed", "f1": "matched", "f2": "matched"}

    def test_owners_that_race_for_writes_never_interleave(
        self, db: Database, mission_id: str, race: Race
    ) -> None:
        """Everybody takes the lease over and over, and saves with the epoch it got; only the newest may."""

        def own(i: int) -> list[tuple[int, int]]:
            written = []
            for _ in range(10):
                with db.write() as tx:
                    epoch = leases.acquire(tx, mission_id, f"owner {i}", 0.0)
                assert epoch is not None
                time.sleep(0.001)
                try:
                    written.append((save(db, mission_id, epoch, PoseUpdate(zoom=epoch)), epoch))
                except LeaseLost:
                    continue
            return written

        written = sorted(w for mine in race(4, own) for w in mine)
        assert [generation for generation, _ in written] == list(range(1, len(written) + 1))
        assert [epoch for _, epoch in written] == sorted(epoch for _, epoch in written)
        with db.read() as tx:
            assert missions.get(tx, mission_id).zoom == written[-1][1]


class TestPoses:
    def test_what_is_saved_is_loaded_to_the_last_bit(
        self, db: Database, mission_id: str, matched: list[str], owner: int
    ) -> None:
        world, place = World(47.1, 9.2, 411.3), placed("f1")
        change = PoseUpdate(
            placed=[place],
            cameras={"camera": CAMERA},
            world=world,
            zoom=Z,
            solved_frames=1,
            reprojection_rms_px=0.7,
        )
        save(db, mission_id, owner, change)
        with db.read() as tx:
            found = poses.load(tx, mission_id)
            mission = missions.get(tx, mission_id)
        frame = found.placed["f1"].posed(found.cameras)
        assert (found.world, found.zoom, found.solved_frames) == (world, Z, 1)
        assert mission.reprojection_rms_px == 0.7
        assert isinstance(frame, PosedFrame)
        assert frame.camera == CAMERA
        np.testing.assert_array_equal(frame.pose.world_R_cam, place.pose.world_R_cam)
        np.testing.assert_array_equal(frame.pose.center, place.pose.center)
        assert (frame.pose.ground_h_m, frame.pose.source, frame.pose.submap) == (1.25, "visual", 3)
        assert (frame.pose.sigma_m, frame.gain) == ((0.1, 0.2, 0.3), (1.0, 1.0, 0.9))
        assert found.placed["f1"].box == place.box

    def test_only_what_changed_gets_the_new_generation(
        self, db: Database, mission_id: str, matched: list[str], owner: int
    ) -> None:
        save(db, mission_id, owner, PoseUpdate(placed=[placed("f0"), placed("f1"), placed("f2")]))
        changed = [placed("f0"), placed("f1", east_m=0.2), placed("f2", gain=1.1)]
        assert save(db, mission_id, owner, PoseUpdate(placed=changed)) == 2
        with db.read() as tx:
            found = poses.load(tx, mission_id)
        assert {k: p.generation for k, p in found.placed.items()} == {"f0": 1, "f1": 2, "f2": 2}
        assert states(db, mission_id) == dict.fromkeys(matched, "posed")

    def test_an_unplaced_frame_loses_its_pose_and_may_get_it_back(
        self, db: Database, mission_id: str, matched: list[str], owner: int
    ) -> None:
        save(db, mission_id, owner, PoseUpdate(placed=[placed("f0"), placed("f1")]))
        save(db, mission_id, owner, PoseUpdate(unplaced={"f1": ("far_from_mission", "Far away.")}))
        assert states(db, mission_id) == {"f0": "posed", "f1": "rejected", "f2": "matched"}
        with db.read() as tx:
            assert list(poses.load(tx, mission_id).placed) == ["f0"]
        save(db, mission_id, owner, PoseUpdate(placed=[placed("f1")]))
        assert states(db, mission_id)["f1"] == "posed"

    def test_a_box_finds_the_frames_that_touch_it(
        self, db: Database, mission_id: str, matched: list[str], owner: int
    ) -> None:
        save(db, mission_id, owner, PoseUpdate(placed=[placed("f0", 0), placed("f1", 2), placed("f2", 4)]))
        with db.read() as tx:
            assert list(poses.load(tx, mission_id, TileBox(Z, 1, 1, 2, 5)).placed) == ["f0", "f1"]
            assert list(poses.load(tx, mission_id, TileBox(Z, 6, 0, 9, 9)).placed) == []
            assert list(poses.load(tx, mission_id, TileBox(Z + 1, 0, 0, 9, 9)).placed) == []
