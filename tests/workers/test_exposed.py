"""A photo that joins a growing map is as bright as the ground that it overlaps, whoever lies next to it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from core.coverage import tiles_under
from core.geometry import Camera, Pose, PosedFrame, World
from core.glance import Glance, glance
from core.matching import MatchCounts, PairMatch
from core.mosaic import Layout
from workers.posing import EXPOSED_BY, exposed

WORLD, ZOOM = World(47.0, 8.0, 400.0), 20
CAMERA = Camera(1600, 1200, 1400.0, 799.5, 599.5)
LIGHTS = {"a": 1.0, "b": 1.5, "c": 0.7, "d": 1.2, "new": 0.6}


def frame(name: str, east_m: float, gain: float) -> PosedFrame:
    pose = Pose(np.diag([1.0, -1.0, -1.0]), np.array([east_m, 0.0, 70.0]), 0.0)
    return PosedFrame(name, CAMERA, pose, (gain,) * 3)


def layout() -> Layout:
    """Four frames whose exposure is known, and a new one, 20 m apart each."""
    frames = {k: frame(k, 20.0 * n, 1 / LIGHTS[k]) for n, k in enumerate("abcd")}
    frames["new"] = frame("new", 80.0, 1.0)
    under = {k: frozenset(tiles_under(f, WORLD, ZOOM)) for k, f in frames.items()}
    return Layout(WORLD, ZOOM, {"camera": CAMERA}, frames, under, {})


def look(name: str) -> Glance:
    """The same waves on the ground, under each photo's own light."""
    us, vs = np.meshgrid((np.arange(128) + 0.5) * 12.5 - 0.5, (np.arange(96) + 0.5) * 12.5 - 0.5)
    at = layout().frames[name]
    x, y, _ = at.pose.ground(CAMERA, np.column_stack((us.ravel(), vs.ravel()))).T
    grey = 115 + 40 * np.sin(x / 9) * np.cos(y / 7)
    light = grey / (256 - grey) * LIGHTS[name]
    shown = (256 * light / (1 + light)).astype(np.uint8).reshape(96, 128, 1)
    return glance(np.repeat(shown, 3, axis=2))


def match(low: str, high: str, points: int) -> PairMatch:
    uv = np.zeros((points, 2), np.float32)
    return PairMatch(low, high, True, "ok", uv, uv, MatchCounts(final=points))


@pytest.mark.parametrize(
    "matches", [[], [match("c", "new", 40), match("d", "new", 90)], [match("b", "c", 99)]]
)
def test_it_is_as_bright_as_its_neighbours(matches: list[PairMatch]) -> None:
    before = layout()
    after = exposed(before, {"new"}, matches, look)
    assert after.frames["new"].gain == pytest.approx((1 / LIGHTS["new"],) * 3, rel=0.02)
    assert {k: f for k, f in after.frames.items() if k != "new"} == {
        k: f for k, f in before.frames.items() if k != "new"
    }


def test_few_are_looked_at_and_those_that_it_matches_best() -> None:
    asked: list[str] = []
    matches = [match(k, "new", n) for n, k in enumerate("abcd", 20)]
    exposed(layout(), {"new"}, matches, lambda k: (asked.append(k), look(k))[1])
    assert sorted(asked) == ["b", "c", "d", "new"]
    assert len(asked) == EXPOSED_BY + 1


def test_a_frame_that_could_not_be_placed_is_nobodys() -> None:
    before = layout()
    alone = replace(before, frames={"new": before.frames["new"]})
    assert exposed(before, {"lost"}, [], look).frames == before.frames
    assert exposed(alone, {"new"}, [], look).frames["new"].gain == (1.0, 1.0, 1.0)
