"""Tiles go dirty → claimed → rendered; nothing that comes late overwrites anything newer."""

from __future__ import annotations

from services.catalog import tiles
from services.catalog.tiles import Key, Render
from services.database import Database
from tests.services.mission_rows import Race, Z, dirty_keys, render, show


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
