"""What a growing layout shows: kept up to date photo by photo, it is what two whole layouts differ by."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from core.coverage import tiles_under
from core.geometry import Camera, Pose, PosedFrame, World
from core.mosaic import Layout
from services.catalog.tiles import GROWN, NEW
from workers.posing import Known, changed

ZOOM = 20
WORLD = World(47.26, 17.35, 120.0)
CAMERA = Camera(640, 480, 450.0, 319.5, 239.5)


def frames(n: int, seed: int) -> list[PosedFrame]:
    """Photos that look down from 60 m, all over a field of 240 m; every fifth where another one is."""
    rng = np.random.default_rng(seed)
    found: list[PosedFrame] = []
    for k in range(n):
        at = found[k // 2].pose.center[:2] if k % 5 == 4 else rng.uniform(-120, 120, 2)
        c, s = np.cos(turn := rng.uniform(0, 6.28)), np.sin(turn)
        down = np.array([[c, s, 0.0], [s, -c, 0.0], [0.0, 0.0, -1.0]])
        pose = Pose(down, np.array([*at, 60.0]), 0.0)
        found.append(PosedFrame(f"{k:03d}", CAMERA, pose))
    return found


def layout(some: list[PosedFrame]) -> Layout:
    under = {f.frame_id: frozenset(tiles_under(f, WORLD, ZOOM)) for f in some}
    return Layout(WORLD, ZOOM, {}, {f.frame_id: f for f in some}, under, {})


def test_what_a_photo_changes_is_what_the_two_layouts_differ_by() -> None:
    everyone = frames(70, seed=1)
    known = Known(0, layout(everyone[:4]), 4)
    given: list[int] = []
    at, unchanged = 4, False
    while at < len(everyone):
        count = 1 + at % 3
        after = layout(everyone[: at + count])
        assert known.layout is not None
        expected = changed(known.layout, after).dirty(0)
        found = known.grown(after, {f.frame_id for f in everyone[at : at + count]})
        assert found == expected
        given += found.values()
        unchanged |= any(
            tile not in found for f in everyone[at : at + count] for tile in after.under[f.frame_id]
        )
        known.layout, at = after, at + count
    assert {NEW, GROWN} <= set(given)
    assert unchanged


def test_a_layout_that_came_otherwise_is_looked_at_anew() -> None:
    everyone = frames(30, seed=2)
    known = Known(0, layout(everyone[:10]), 10)
    known.grown(layout(everyone[:20]), {f.frame_id for f in everyone[10:20]})  # saving it failed
    after = layout(everyone[:12])
    assert known.layout is not None
    expected = changed(known.layout, after).dirty(0)
    assert expected
    assert known.grown(after, {"010", "011"}) == expected


def test_a_frame_that_had_a_place_changes_what_it_leaves() -> None:
    everyone = frames(30, seed=3)
    known = Known(0, layout(everyone), 30)
    moved = replace(everyone[3], pose=replace(everyone[3].pose, center=np.array([300.0, 300.0, 60.0])))
    after = layout([*everyone[:3], moved, *everyone[4:]])
    assert known.grown(after, {"003"}) == changed(layout(everyone), after).dirty(0)
