"""Which tiles another layout changes: at no time is there a hole where a frame on the map sees the ground."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest

from core.coverage import block_grid, tiles_under
from core.geometry import Camera, Pose, PosedFrame, World
from core.grid import TILE_PX, TileKey
from core.mosaic import Layout
from core.patching import CELL_PX, cells_of, surely_shows
from services.catalog.tiles import GROWN, HEAL, NEW
from workers.posing import changed

WORLD = World(47.0, 8.0, 400.0)
CAMERA = Camera(1600, 1200, 1400.0, 799.5, 599.5)
DOWN = np.diag([1.0, -1.0, -1.0])
ZOOM = 20
STEP_M = np.array([45.0, 45.0])


def frame(name: str, east_m: float, north_m: float, yaw_rad: float = 0.0) -> PosedFrame:
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    turned = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ DOWN
    return PosedFrame(name, CAMERA, Pose(turned, np.array([east_m, north_m, 70.0]), 0.0))


def layout(frames: Mapping[str, PosedFrame]) -> Layout:
    under = {k: frozenset(tiles_under(f, WORLD, ZOOM)) for k, f in frames.items()}
    return Layout(WORLD, ZOOM, {"camera": CAMERA}, dict(frames), under, {})


def seen(tile: TileKey, at: Layout) -> np.ndarray:
    """Which cells of the tile any frame surely shows: those that live drawing fills."""
    grid = block_grid([tile])
    cells, resolution_m = cells_of(grid, WORLD), grid.resolution_m(WORLD)
    found = np.zeros(len(cells.foot), bool)
    for k, under in at.under.items():
        if tile in under:
            found |= surely_shows(at.frames[k], cells, resolution_m)
    return found


@pytest.mark.parametrize("seed", range(4))
def test_what_the_frames_see_is_shown_though_nothing_is_healed(seed: int) -> None:
    """Frames come two by two, and every now and then all of them move, by as much as GPS may be off."""
    chance = np.random.default_rng(seed)
    frames: dict[str, PosedFrame] = {}
    at: Layout | None = None
    shown: dict[TileKey, np.ndarray] = {}
    for turn in range(10):
        frames = dict(frames)
        if turn % 3 == 2:
            shift = {k: chance.normal(0, 4.0, 2) for k in frames}
            frames = {
                k: frame(k, *(f.pose.center[:2] + shift[k]), float(chance.normal(0, 0.1)))
                for k, f in frames.items()
            }
        else:
            for side in (0, 1):
                place = STEP_M * (turn, side) + chance.normal(0, 4.0, 2)
                frames[f"{turn}{side}"] = frame(f"{turn}{side}", *place)
        after = layout(frames)
        for tile in changed(at, after).dirty(0):
            key = TileKey(*tile)
            shown[key] = shown.get(key, np.zeros((TILE_PX // CELL_PX) ** 2, bool)) | seen(key, after)
        for tile in after.cover:
            assert not (seen(tile, after) & ~shown[tile]).any(), f"a hole in {tile} after turn {turn}"
        at = after


def test_a_frame_that_moved_where_nobody_saw_the_ground_is_drawn_there_whatever_may_be_healed() -> None:
    still = {"a": frame("a", 0, 0), "b": frame("b", 0, 160)}  # there is a gap between them
    before, after = layout(still), layout(still | {"a": frame("a", 0, 30)})
    gap = {t for t in before.cover & after.cover if (seen(t, after) & ~seen(t, before)).any()}
    dirty = changed(before, after).dirty(0)
    assert gap
    assert {t: dirty.get(t) for t in gap} == dict.fromkeys(gap, GROWN)
    assert {t for t, priority in dirty.items() if priority == NEW} == after.cover - before.cover


def test_moved_tiles_that_show_no_new_ground_only_heal() -> None:
    many = {f"{i}{j}": frame(f"{i}{j}", 12.0 * i, 12.0 * j) for i in range(9) for j in range(9)}
    before = layout(many)
    after = layout(many | {"44": frame("44", 48.5, 48.5)})
    assert changed(before, after).new == {}
    assert set(changed(before, after).dirty(10**6).values()) == {HEAL}
    assert changed(before, after).dirty(0) == {}
