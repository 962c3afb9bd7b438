"""One owner writes poses; tiles go dirty → rendered → published; nothing late overwrites anything newer."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import pytest
from sqlalchemy import select

from core.frame import FrameMeta
from core.geometry import Camera, Pose, PosedFrame, World
from services.catalog import events, frames, leases, missions, poses, tiles
from services.catalog.poses import Placed, PoseUpdate
from services.catalog.standstill import stalled
from services.catalog.tiles import Key, Render, TileBox
from services.catalog.wakes import Wake
from services.database import Database
from services.errors import LeaseLost, MissionNotFound, RevisionConflict
from services.tables import DirtyTile

Race = Callable[[int, Callable[[int], Any]], list[Any]]
CAMERA = Camera(4000, 3000, 2800.25, 1999.5, 1499.5, -0.01, 0.001)
Z = 18


def placed(frame_id: str, x: int = 0, east_m: float = 0.1, gain: float = 1.0) -> Placed:
    """A frame over tiles (x, 0) … (x + 1, 1)."""
    rotation = np.array([[0.6, 0.8, 0.0], [0.8, -0.6, 0.0], [0.0, 0.0, -1.0]])
    pose = Pose(rotation, np.array([east_m, 2.0 / 3, 80.0]), 1.25, "visual", 3, (0.1, 0.2, 0.3))
    return Placed(frame_id, "camera", pose, TileBox(Z, x, 0, x + 1, 1), (gain, 1.0, 0.9))


def dirty(*frames_x: int, priority: int = tiles.GROWN) -> dict[Key, int]:
    return {(Z, x + dx, y): priority for x in frames_x for dx in (0, 1) for y in (0, 1)}


def render(key: Key, generation: int, etag: str = "") -> Render:
    name = etag or f"g{generation}"
    return Render(key, generation, f"tiles/{key[1]}/{key[2]}/{name}", name, "image/jpeg", 100)


@pytest.fixture
def owner(db: Database, mission_id: str) -> int:
    with db.write() as tx:
        epoch = leases.acquire(tx, mission_id, "me", 3600.0)
    assert epoch is not None
    return epoch


@pytest.fixture
def matched(db: Database, mission_id: str) -> list[str]:
    ids = ["f0", "f1", "f2"]
    with db.write() as tx:
        for frame_id in ids:
            frames.receive(tx, mission_id, frame_id, frame_id, 1, "image/jpeg", 4000, 3000, now=1.0)
            frames.mark_ready(tx, mission_id, frame_id, FrameMeta(4000, 3000), 1.0)
            frames.mark_matched(tx, mission_id, frame_id, 1.0)
    return ids


def save(db: Database, mission_id: str, epoch: int, change: PoseUpdate) -> int:
    with db.write() as tx:
        return poses.save(tx, mission_id, epoch, change)


def show(db: Database, mission_id: str, renders: Iterable[Render]) -> int:
    """Record these renders and publish all that is pending, as the publisher does."""
    with db.write() as tx:
        tiles.record_renders(tx, mission_id, list(renders))
    with db.read() as tx:
        revision = missions.get(tx, mission_id).revision
        pending = tiles.pending_renders(tx, mission_id)
    with db.write() as tx:
        return tiles.publish(tx, mission_id, revision, pending, pending)


def dirty_keys(db: Database, mission_id: str) -> set[Key]:
    with db.read() as tx:
        rows = tx.scalars(select(DirtyTile).where(DirtyTile.mission_id == mission_id))
        return {(d.z, d.x, d.y) for d in rows}


def states(db: Database, mission_id: str) -> dict[str, str]:
    with db.read() as tx:
        return {f.id: f.state for f in frames.list(tx, mission_id)}


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


class TestDirtyTiles:
    def test_claims_are_by_blocks_and_best_priority_first(self, db: Database, mission_id: str) -> None:
        with db.write() as tx:
            tiles.mark_dirty(tx, mission_id, {(Z, x, y): 5 for x in range(4) for y in range(4)}, 1)
            tiles.mark_dirty(tx, mission_id, [(Z, 3, 3)], 2, priority=0)
            first = tiles.claim_dirty(tx, mission_id, 6, 10.0, now=0.0)
            assert [(d.x, d.y) for d in first] == [(2, 2), (2, 3), (3, 2), (3, 3)]
            assert {d.generation for d in first} == {1, 2}
            tiny = tiles.claim_dirty(tx, mission_id, 1, 10.0, now=0.0)
            assert [(d.x, d.y) for d in tiny] == [(0, 0), (0, 1), (1, 0), (1, 1)]
            assert len(tiles.claim_dirty(tx, mission_id, 100, 10.0, now=0.0)) == 8
            assert tiles.claim_dirty(tx, mission_id, 100, 10.0, now=9.0) == []
            assert len(tiles.claim_dirty(tx, mission_id, 100, 10.0, now=10.0)) == 16  # the renderer died

    def test_ground_to_be_added_does_not_wait_for_new_ground_that_came_later(
        self, db: Database, mission_id: str
    ) -> None:
        grown, waited = (Z, 0, 0), 0
        with db.write() as tx:
            tiles.mark_dirty(tx, mission_id, {(Z, 98, 0): tiles.HEAL}, 1)
            tiles.mark_dirty(tx, mission_id, {grown: tiles.GROWN, (Z, 2, 0): tiles.NEW}, 2)
            for turn in range(3, 9):  # faster than tiles are drawn
                tiles.mark_dirty(
                    tx, mission_id, {(Z, 4 * turn, 0): tiles.NEW, (Z, 4 * turn, 2): tiles.NEW}, turn
                )
                (claimed,) = tiles.claim_dirty(tx, mission_id, 1, 100.0, now=0.0)
                waited += 1
                if (claimed.z, claimed.x, claimed.y) == grown:
                    break
        assert waited == 2

    def test_nobody_gets_a_tile_that_another_has(self, db: Database, mission_id: str, race: Race) -> None:
        with db.write() as tx:
            tiles.mark_dirty(
                tx, mission_id, {(Z, x, y): (x * y) % 7 for x in range(20) for y in range(20)}, 1
            )

        def claim(_: int) -> list[Key]:
            mine: list[Key] = []
            while True:
                with db.write() as tx:
                    some = tiles.claim_dirty(tx, mission_id, 8, 3600.0)
                if not some:
                    return mine
                mine += [(d.z, d.x, d.y) for d in some]

        got = [key for mine in race(4, claim) for key in mine]
        assert len(got) == len(set(got)) == 400

    def test_dirtied_again_while_it_is_rendered_it_stays_dirty(self, db: Database, mission_id: str) -> None:
        key = (Z, 5, 5)
        with db.write() as tx:
            tiles.mark_dirty(tx, mission_id, [key], 1)
            (claimed,) = tiles.claim_dirty(tx, mission_id, 4, 100.0, now=0.0)
            tiles.mark_dirty(tx, mission_id, [key], 2)
        assert show(db, mission_id, [render(key, claimed.generation)]) == 1
        assert dirty_keys(db, mission_id) == {key}
        with db.write() as tx:
            (again,) = tiles.claim_dirty(tx, mission_id, 4, 100.0, now=1.0)
            assert again.generation == 2
        assert show(db, mission_id, [render(key, 2)]) == 2
        assert dirty_keys(db, mission_id) == set()

    def test_dirtied_again_between_render_and_publication_it_stays_dirty(
        self, db: Database, mission_id: str
    ) -> None:
        key = (Z, 5, 5)
        with db.write() as tx:
            tiles.mark_dirty(tx, mission_id, [key], 1)
            tiles.record_renders(tx, mission_id, [render(key, 1)])
            pending = tiles.pending_renders(tx, mission_id)
            tiles.mark_dirty(tx, mission_id, [key], 2)
            tiles.publish(tx, mission_id, 0, pending, pending)
        assert dirty_keys(db, mission_id) == {key}
        with db.read() as tx:
            assert tiles.pending_renders(tx, mission_id) == []

    def test_a_newer_render_that_comes_during_publication_is_kept(
        self, db: Database, mission_id: str
    ) -> None:
        key = (Z, 5, 5)
        with db.write() as tx:
            tiles.mark_dirty(tx, mission_id, [key], 1)
            tiles.record_renders(tx, mission_id, [render(key, 1)])
            pending = tiles.pending_renders(tx, mission_id)
            tiles.mark_dirty(tx, mission_id, [key], 2)
            tiles.record_renders(tx, mission_id, [render(key, 2)])
            tiles.publish(tx, mission_id, 0, pending, pending)
            assert tiles.pending_renders(tx, mission_id) == [render(key, 2)]

    def test_an_older_render_never_replaces_a_newer_one(self, db: Database, mission_id: str) -> None:
        key = (Z, 5, 5)
        with db.write() as tx:
            tiles.mark_dirty(tx, mission_id, [key], 2)
            tiles.record_renders(tx, mission_id, [render(key, 2)])
            tiles.record_renders(tx, mission_id, [render(key, 1), render((Z, 9, 9), 1)])
            assert tiles.pending_renders(tx, mission_id) == [render(key, 2)]

    def test_an_empty_render_comes_back_empty(self, db: Database, mission_id: str) -> None:
        with db.write() as tx:
            tiles.mark_dirty(tx, mission_id, [(Z, 0, 0)], 1)
            tiles.record_renders(tx, mission_id, [Render((Z, 0, 0), 1)])
            assert tiles.pending_renders(tx, mission_id) == [Render((Z, 0, 0), 1)]


class TestPublishing:
    def test_a_revision_is_published_once(self, db: Database, mission_id: str, race: Race) -> None:
        def publish(i: int) -> int:
            done = 0
            for revision in range(5):
                try:
                    with db.write() as tx:
                        tiles.publish(
                            tx, mission_id, revision, [render((Z, 0, 0), revision, f"{i}-{revision}")], []
                        )
                    done += 1
                except RevisionConflict:
                    while True:  # somebody else did it: wait until that can be seen
                        with db.read() as tx:
                            if missions.get(tx, mission_id).revision > revision:
                                break
            return done

        assert sum(race(4, publish)) == 5
        with db.read() as tx:
            assert missions.get(tx, mission_id).revision == 5

    def test_a_conflict_writes_nothing(self, db: Database, mission_id: str) -> None:
        with db.write() as tx:
            tiles.mark_dirty(tx, mission_id, [(Z, 0, 0)], 1)
        show(db, mission_id, [render((Z, 0, 0), 1)])
        with db.write() as tx:
            tiles.mark_dirty(tx, mission_id, [(Z, 0, 0)], 2)
        with pytest.raises(RevisionConflict), db.write() as tx:
            tiles.publish(tx, mission_id, 0, [render((Z, 0, 0), 2)], [render((Z, 0, 0), 2)])
        with db.read() as tx:
            tile = tiles.get(tx, mission_id, Z, 0, 0)
        assert tile is not None
        assert (tile.etag, dirty_keys(db, mission_id)) == ("g1", {(Z, 0, 0)})

    def test_old_revisions_can_still_be_read(self, db: Database, mission_id: str) -> None:
        a, b = (Z, 0, 0), (Z, 1, 0)
        with db.write() as tx:
            tiles.publish(tx, mission_id, 0, [render(a, 1)], [])
            tiles.publish(tx, mission_id, 1, [render(a, 2), render(b, 2)], [])
            tiles.publish(tx, mission_id, 2, [Render(b, 3)], [])
        with db.read() as tx:

            def etag(key: Key, revision: int | None) -> str | None:
                tile = tiles.get(tx, mission_id, *key, revision=revision)
                return tile.etag if tile else "never"

            assert [etag(a, r) for r in (0, 1, 2, 3, None)] == ["never", "g1", "g2", "g2", "g2"]
            assert [etag(b, r) for r in (1, 2, 3, None)] == ["never", "g2", None, None]
            assert tiles.keys(tx, mission_id) == [a]
            assert set(tiles.current(tx, mission_id, [a, b, (Z, 7, 7)])) == {a, b}

    def test_what_looks_the_same_is_no_news(self, db: Database, mission_id: str) -> None:
        a, b = (Z, 0, 0), (Z, 1, 0)
        with db.write() as tx:
            tiles.publish(tx, mission_id, 0, [render(a, 1, "same")], [])
            tiles.mark_dirty(tx, mission_id, [a, b], 2)
            renders = [render(a, 2, "same"), Render(b, 2)]
            tiles.record_renders(tx, mission_id, renders)
            assert tiles.publish(tx, mission_id, 1, renders, renders) == 1
            assert [e.kind for e in events.since(tx, mission_id, 0)] == ["tiles"]
        assert dirty_keys(db, mission_id) == set()

    def test_viewers_are_told_which_tiles_changed(self, db: Database, mission_id: str) -> None:
        with db.write() as tx:
            tiles.publish(tx, mission_id, 0, [render((Z, 1, 0), 1), render((Z - 1, 0, 0), 1)], [])
            (event,) = events.since(tx, mission_id, 0)
        assert (event.kind, event.payload) == ("tiles", {"revision": 1, "tiles": [[Z - 1, 0, 0], [Z, 1, 0]]})

    def test_bounds_are_of_what_shows(self, db: Database, mission_id: str, owner: int) -> None:
        with db.read() as tx:
            assert tiles.bounds(tx, mission_id) is None
        save(db, mission_id, owner, PoseUpdate(zoom=Z))
        with db.write() as tx:
            shown = [
                render((Z, 3, 4), 1),
                render((Z, 6, 2), 1),
                Render((Z, 9, 9), 1),
                render((Z - 1, 0, 0), 1),
            ]
            tiles.publish(tx, mission_id, 0, shown, [])
        with db.read() as tx:
            assert tiles.bounds(tx, mission_id) == TileBox(Z, 3, 2, 6, 4)


class TestFusedFrames:
    def test_a_frame_is_fused_when_all_of_its_tiles_are_out(
        self, db: Database, mission_id: str, matched: list[str], owner: int
    ) -> None:
        save(db, mission_id, owner, PoseUpdate(placed=[placed("f0", 0), placed("f1", 4)], dirty=dirty(0, 4)))
        keys = sorted(dirty(0, 4))
        show(db, mission_id, [render(k, 1) for k in keys if k != (Z, 1, 1)])
        assert states(db, mission_id) == {"f0": "posed", "f1": "fused", "f2": "matched"}
        show(db, mission_id, [render((Z, 1, 1), 1)])
        assert states(db, mission_id) == {"f0": "fused", "f1": "fused", "f2": "matched"}

    def test_a_neighbour_that_comes_later_does_not_hold_it_up(
        self, db: Database, mission_id: str, matched: list[str], owner: int
    ) -> None:
        save(db, mission_id, owner, PoseUpdate(placed=[placed("f0", 0)], dirty=dirty(0)))
        save(db, mission_id, owner, PoseUpdate(placed=[placed("f1", 1)], dirty=dirty(1)))
        show(db, mission_id, [render(k, 1) for k in dirty(0)])  # rendered before f1 was known
        assert states(db, mission_id) == {"f0": "fused", "f1": "posed", "f2": "matched"}
        show(db, mission_id, [render(k, 2) for k in dirty(1)])
        assert states(db, mission_id)["f1"] == "fused"
        assert dirty_keys(db, mission_id) == set()

    def test_what_is_shown_already_and_only_moves_does_not_hold_it_up(
        self, db: Database, mission_id: str, matched: list[str], owner: int
    ) -> None:
        moved = dict.fromkeys(list(dirty(0))[:1], tiles.HEAL)
        save(db, mission_id, owner, PoseUpdate(placed=[placed("f0", 0)], dirty=dirty(0) | moved))
        show(db, mission_id, [render(k, 1) for k in dirty(0).keys() - moved.keys()])
        assert states(db, mission_id)["f0"] == "fused"
        assert dirty_keys(db, mission_id) == set(moved)

    def test_a_neighbour_that_comes_later_does_not_hide_that_tiles_are_missing(
        self, db: Database, mission_id: str, matched: list[str], owner: int
    ) -> None:
        save(db, mission_id, owner, PoseUpdate(placed=[placed("f0", 0)], dirty=dirty(0)))
        save(db, mission_id, owner, PoseUpdate(placed=[placed("f1", 1)], dirty=dirty(1)))
        show(
            db, mission_id, [render((Z, 0, y), 1) for y in (0, 1)]
        )  # what f0 shares with f1 is not drawn yet
        assert states(db, mission_id)["f0"] == "posed"
        show(db, mission_id, [render((Z, 1, y), 2) for y in (0, 1)])
        assert states(db, mission_id) == {"f0": "fused", "f1": "posed", "f2": "matched"}

    def test_tiles_of_an_older_generation_do_not_show_it(
        self, db: Database, mission_id: str, matched: list[str], owner: int
    ) -> None:
        save(db, mission_id, owner, PoseUpdate(dirty=dirty(0)))
        save(db, mission_id, owner, PoseUpdate(placed=[placed("f0", 0)], dirty=dirty(0)))
        show(db, mission_id, [render(k, 1) for k in dirty(0)])
        assert states(db, mission_id)["f0"] == "posed"
        show(db, mission_id, [render(k, 2) for k in dirty(0)])
        assert states(db, mission_id)["f0"] == "fused"

    def test_it_stays_fused_when_it_is_drawn_again(
        self, db: Database, mission_id: str, matched: list[str], owner: int
    ) -> None:
        save(db, mission_id, owner, PoseUpdate(placed=[placed("f0", 0)], dirty=dirty(0)))
        show(db, mission_id, [render(k, 1) for k in dirty(0)])
        with db.read() as tx:
            first = frames.get(tx, mission_id, "f0").fused_at
        save(db, mission_id, owner, PoseUpdate(placed=[placed("f0", 0, east_m=1.0)], dirty=dirty(0)))
        show(db, mission_id, [render(k, 2) for k in dirty(0)])
        with db.read() as tx:
            frame = frames.get(tx, mission_id, "f0")
        assert (frame.state, frame.fused_at) == ("fused", first)
        assert first is not None


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
