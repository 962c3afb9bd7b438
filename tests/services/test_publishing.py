"""Who publishes: one at a time, and another when that one was killed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from services.catalog import missions, publishing, tiles
from services.catalog.tiles import Key, Render
from services.database import Database
from services.errors import RevisionConflict
from services.tables import DirtyTile

Race = Callable[[int, Callable[[int], Any]], list[Any]]

Z, TTL_S = 20, 30.0
KEYS: list[Key] = [(Z, 0, 0), (Z, 1, 0), (Z, 4, 4)]


def rendered(db: Database, mission_id: str, keys: list[Key], generation: int = 1) -> None:
    with db.write() as tx:
        tiles.mark_dirty(tx, mission_id, keys, generation)
        tiles.record_renders(tx, mission_id, [Render(k, generation, f"{k}", f"{k}") for k in keys])


def claim(db: Database, mission_id: str, now: float, revision: int = 0) -> float | None:
    with db.write() as tx:
        return publishing.claim(tx, mission_id, revision, TTL_S, now)


def test_of_many_who_would_publish_one_does(db: Database, mission_id: str, race: Race) -> None:
    rendered(db, mission_id, KEYS)
    assert sorted(c is not None for c in race(6, lambda i: claim(db, mission_id, 1.0 + i / 10))) == [
        *[False] * 5,
        True,
    ]


def test_a_killed_publishers_claim_runs_out(db: Database, mission_id: str) -> None:
    rendered(db, mission_id, KEYS)
    assert claim(db, mission_id, 1.0) == 1.0
    assert claim(db, mission_id, 1.0 + TTL_S - 0.1) is None
    assert claim(db, mission_id, 1.0 + TTL_S) is not None


def test_a_claim_ends_with_its_release_also_of_a_tile_that_is_dirty_again(
    db: Database, mission_id: str
) -> None:
    rendered(db, mission_id, KEYS)
    mine = claim(db, mission_id, 1.0)
    assert mine is not None
    with db.write() as tx:
        tiles.mark_dirty(tx, mission_id, KEYS[:1], 2)
        publishing.release(tx, mission_id, mine)
    assert claim(db, mission_id, 2.0) is not None
    with db.write() as tx:
        assert [d.x for d in tiles.claim_dirty(tx, mission_id, 9, TTL_S, now=2.5)] == [0]


def test_a_tile_that_somebody_draws_anew_stays_with_them_when_its_older_picture_is_published(
    db: Database, mission_id: str
) -> None:
    rendered(db, mission_id, KEYS)
    with db.write() as tx:
        tiles.mark_dirty(tx, mission_id, KEYS[:1], 2)
        tiles.claim_dirty(tx, mission_id, 9, TTL_S, now=1.0)
    mine = claim(db, mission_id, 2.0)
    assert mine is not None
    with db.write() as tx:
        publishing.release(tx, mission_id, mine)
    with db.read() as tx:
        row = tx.get(DirtyTile, (mission_id, *KEYS[0]))
        assert row is not None
        assert row.claimed_at == 1.0


def test_who_has_looked_at_an_older_revision_looks_again(db: Database, mission_id: str) -> None:
    rendered(db, mission_id, KEYS)
    with db.write() as tx:
        pending = tiles.pending_renders(tx, mission_id)
        tiles.publish(tx, mission_id, missions.get(tx, mission_id).revision, pending, pending)
    with pytest.raises(RevisionConflict):
        claim(db, mission_id, 1.0, revision=0)
