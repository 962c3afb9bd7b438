"""What publishing leaves to do: the overviews next to the tiles are made where those are drawn."""

from __future__ import annotations

from typing import Any

import pytest

from services.catalog import backlog, missions, publishing
from services.tables import DirtyTile


def test_the_final_pass_leaves_no_overview_of_native_tiles_to_publish(
    bench: Any,
    photos: list[tuple[str, bytes]],
    expected: dict[tuple[int, int, int], bytes],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    publish = bench.modules["publish"]
    made: list[int] = []
    really = publish.putting

    def remember(store: Any, mission_id: str, generation: int, tile: Any, encoded: Any) -> Any:
        if encoded is not None:
            made.append(tile.z)
        return really(store, mission_id, generation, tile, encoded)

    bench.upload(photos)
    bench.drain()
    monkeypatch.setattr(publish, "putting", remember)
    bench.finalise()
    bench.drain()
    with bench.db.read() as tx:
        zoom = missions.get(tx, bench.mission_id).zoom
    assert made
    assert max(made) < zoom - 1
    assert bench.tiles() == expected


def test_an_overview_made_with_other_siblings_than_are_shown_is_made_again(
    bench: Any, photos: list[tuple[str, bytes]], expected: dict[tuple[int, int, int], bytes]
) -> None:
    """As when a run of tiles was cut off between two siblings, and done again."""
    bench.upload(photos)
    bench.drain()
    bench.finalise()
    chance = True
    while bench.queue:
        name, args = bench.queue.pop(0)
        if name == "fuse" and chance:
            chance, (mission_id, keys) = False, args
            for key in keys:  # one by one: each makes an overview of itself alone
                bench.handle("fuse", mission_id, [key])
        bench.handle(name, *args)
    assert bench.state == "final"
    assert bench.tiles() == expected


def test_the_last_revision_is_a_small_one(bench: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever has drawn the last tile waits for its overviews: those of the others are made before."""
    publish, workers = bench.modules["publish"], bench.modules["app"].settings.workers
    monkeypatch.setattr(publish, "ENOUGH", 1000 * workers)
    few = publish.LAST_TILES * workers
    assert not publish._worth_it(publish.ENOUGH - 1, 10 * few, final=True)
    assert publish._worth_it(publish.ENOUGH, 10 * few, final=True)
    assert publish._worth_it(few, few, final=True)
    assert not publish._worth_it(few, few + 1, final=True)
    assert not publish._worth_it(few - 1, 1, final=True)  # the last one may as well show these too


def test_who_finds_another_publishing_wakes_nobody(bench: Any, photos: list[tuple[str, bytes]]) -> None:
    """Or the sequencer, that sees tiles to publish, and the workers would wake each other all the while."""
    bench.upload(photos[:3])
    while bench.queue:
        name, args = bench.queue.pop(0)
        if name != "publish":
            bench.handle(name, *args)
    with bench.db.write() as tx:
        publishing.claim(tx, bench.mission_id, missions.get(tx, bench.mission_id).revision, 30.0)
    assert _to_publish(bench)
    bench.handle("publish", bench.mission_id)
    assert bench.queue == []
    assert _to_publish(bench)
    with bench.db.write() as tx:  # as when that one was killed, and time went by
        publishing.release(tx, bench.mission_id, _claimed_at(tx, bench.mission_id))
    bench.handle("publish", bench.mission_id)
    assert not _to_publish(bench)
    assert bench.queue == [("sequence", (bench.mission_id,))]


def _to_publish(bench: Any) -> int:
    with bench.db.read() as tx:
        return int(backlog.of(tx, bench.mission_id, 30).to_publish)


def _claimed_at(tx: Any, mission_id: str) -> float:
    return float(tx.query(DirtyTile).filter_by(mission_id=mission_id).first().claimed_at)
