"""A map that is final at preview size and then sharpens: the oracle's full tiles in the end, never a hole."""

from __future__ import annotations

import random
from typing import Any

import pytest

from core.coverage import overview, quarter
from core.grid import TileKey, ancestors, children
from core.mosaic import Mosaic, build
from services.catalog import missions, tiles

SIDE_PX = 256
Tiles = dict[tuple[int, int, int], bytes]


@pytest.fixture
def sharp(bench: Any) -> Any:
    """A mission that is drawn at preview size first."""
    with bench.db.write() as tx:
        bench.mission_id = missions.create(tx, "sharpens", "visual", SIDE_PX, backfill=True).id
    return bench


@pytest.fixture(scope="module")
def preview(photos: list[tuple[str, bytes]]) -> Mosaic:
    return build(photos, SIDE_PX)


def until_sharpening(bench: Any, chance: random.Random | None = None) -> None:
    bench.finalise()
    while bench.state != "sharpening":
        name, args = bench.queue.pop(chance.randrange(len(bench.queue)) if chance else 0)
        bench.handle(name, *args)


def all_shown(bench: Any, z: int, expected: Tiles) -> bool:
    """Whether each of these tiles of one zoom shows something."""
    return {k for k in expected if k[0] == z} <= bench.tiles().keys()


@pytest.mark.parametrize("seed", [None, 1])
def test_it_shows_the_preview_first_and_the_full_oracle_in_the_end_without_a_hole_between(
    sharp: Any, photos: list[tuple[str, bytes]], expected: Tiles, preview: Mosaic, seed: int | None
) -> None:
    chance = None if seed is None else random.Random(seed)
    before = {tuple(k): v for k, v in preview.tiles.items()}
    zoom = preview.layout.zoom
    assert zoom is not None
    sharp.upload(photos)
    sharp.drain(chance)
    until_sharpening(sharp, chance)
    assert sharp.tiles() == before
    shares = []
    while sharp.queue:
        name, args = sharp.queue.pop(chance.randrange(len(sharp.queue)) if chance else 0)
        sharp.handle(name, *args)
        assert all_shown(sharp, zoom, before)
        with sharp.db.read() as tx:
            shares.append(missions.progress(tx, sharp.mission_id).sharpened)
    assert sharp.state == "final"
    assert sharp.tiles() == expected
    told = [s for s in shares if s is not None]
    assert told == sorted(told)
    with sharp.db.read() as tx:
        row = missions.get(tx, sharp.mission_id)
    assert (row.full, row.drawn_side, row.sharp_zoom) == (True, None, None)


def test_full_photos_may_need_more_bands_than_the_preview(
    sharp: Any, photos: list[tuple[str, bytes]], preview: Mosaic, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("core.coverage.USUAL_SIDE_PX", SIDE_PX)
    full = build(photos)
    assert full.layout.fusion.bands == preview.layout.fusion.bands + 1
    sharp.upload(photos)
    sharp.drain()
    until_sharpening(sharp)
    assert sharp.tiles() == {tuple(k): v for k, v in preview.tiles.items()}
    sharp.drain(random.Random(2))
    assert sharp.tiles() == {tuple(k): v for k, v in full.tiles.items()}


def test_every_overview_is_the_reduction_of_its_children_at_each_revision(
    sharp: Any, photos: list[tuple[str, bytes]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sharp.modules["publish"], "ENOUGH_LIVE", 1)
    monkeypatch.setattr(sharp.modules["sequence"], "LIVE_TILES", 4)
    sharp.upload(photos)
    sharp.drain()
    until_sharpening(sharp)
    with sharp.db.read() as tx:
        first = missions.get(tx, sharp.mission_id)
    sharp.drain(random.Random(3))
    with sharp.db.read() as tx:
        last = missions.get(tx, sharp.mission_id).revision
    assert last > first.revision + 1  # it came in several parts
    store = sharp.modules["app"].store
    for revision in range(first.revision, last + 1):
        with sharp.db.read() as tx:
            shown = {t.key: store.get(t.object_key) for t in tiles.at(tx, sharp.mission_id, revision)}
        # Above the preview's own tiles always; below, a parent shows the preview until all its children do.
        for tile in ancestors([TileKey(*k) for k in shown if k[0] == first.zoom]):
            if tuple(tile) in shown:
                parts = [quarter(shown[c]) if c in shown else None for c in children(tile)]
                made = overview(parts)
                assert made is not None
                assert shown[tuple(tile)] == made[0]


def test_a_photo_that_comes_meanwhile_opens_the_mission_and_the_end_is_the_same(
    sharp: Any,
    photos: list[tuple[str, bytes]],
    expected: Tiles,
    preview: Mosaic,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sharp.modules["publish"], "ENOUGH_LIVE", 1)
    monkeypatch.setattr(sharp.modules["sequence"], "LIVE_TILES", 4)
    sharp.upload(photos[:6])
    sharp.drain()
    until_sharpening(sharp)
    while {k[0] for k in sharp.tiles()} <= {k.z for k in preview.tiles}:
        name, args = sharp.queue.pop(0)
        sharp.handle(name, *args)
    assert sharp.state == "sharpening"  # some of it is drawn, not all
    sharp.upload(photos[6:])
    assert sharp.state == "open"
    assert {k[0] for k in sharp.tiles()} <= {k.z for k in preview.tiles}
    sharp.drain()
    until_sharpening(sharp)
    assert sharp.tiles() == {tuple(k): v for k, v in preview.tiles.items()}
    sharp.drain()
    assert sharp.state == "final"
    assert sharp.tiles() == expected


def test_a_sharpened_mission_stays_at_full_resolution_when_photos_come(
    sharp: Any, photos: list[tuple[str, bytes]], expected: Tiles
) -> None:
    sharp.upload(photos[:5])
    sharp.drain()
    sharp.finalise()
    sharp.drain()
    zoom = max(k[0] for k in sharp.tiles())
    sharp.upload(photos[5:])
    sharp.drain()
    assert max(k[0] for k in sharp.tiles()) == zoom == max(k[0] for k in expected)
    sharp.finalise()
    sharp.drain()
    assert sharp.state == "final"
    assert sharp.tiles() == expected
