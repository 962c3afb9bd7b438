"""Rendered tiles become a revision; frames are on the map when theirs are."""

from __future__ import annotations

import pytest

from services.catalog import events, frames, missions, tiles
from services.catalog.poses import PoseUpdate
from services.catalog.tiles import Key, Render, TileBox
from services.database import Database
from services.errors import RevisionConflict
from tests.services.mission_rows import Race, Z, dirty, dirty_keys, placed, render, save, show, states


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
