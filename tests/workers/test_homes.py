"""Which map each frame is part of is known after every photo as if all had been looked through again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from core.geometry import Camera, Pose, PosedFrame, World
from core.mosaic import Layout
from workers.homes import Homes

CAMERA = Camera(1600, 1200, 1400.0, 799.5, 599.5)
SOURCES = ("visual", "gnss", "waiting", "alone", "rejected")


def with_frame(layout: Layout, name: str, source: str, submap: int) -> Layout:
    """The layout with one more frame, or with one that lies elsewhere now."""
    pose = Pose(np.eye(3), np.zeros(3), 0.0, "gnss" if source == "gnss" else "visual", submap)
    frames = {k: f for k, f in layout.frames.items() if k != name}
    waiting = {k: p for k, p in layout.waiting.items() if k != name}
    if source in ("visual", "gnss"):
        frames[name] = PosedFrame(name, CAMERA, pose)
    elif source in ("waiting", "alone"):
        waiting[name] = None if source == "alone" else pose
    return replace(layout, frames=frames, waiting=waiting)


@pytest.mark.parametrize("seed", range(5))
def test_grown_frame_by_frame_it_is_as_if_made_at_once(seed: int) -> None:
    rng = np.random.default_rng(seed)
    layout = Layout(World(0.0, 0.0, 0.0), 20, {}, {}, {}, {})
    located = {f"{k:02x}" for k in rng.permutation(60)[:30]}
    homes = Homes(layout, located)
    for name in (f"{k:02x}" for k in rng.integers(0, 60, 150)):  # some come again, and lie elsewhere
        layout = with_frame(layout, name, str(rng.choice(SOURCES)), int(rng.integers(3)))
        homes.grow(layout, {name})
        anew = Homes(layout, located)
        assert dict(homes) == dict(anew)
        assert (homes.maps, homes.located, len(homes)) == (anew.maps, anew.located, len(anew))
    assert homes.maps == len(set(homes.values())) > 3
    assert homes.located == len(located & homes.keys()) > 0


def test_who_ties_to_nothing_is_a_map_of_its_own() -> None:
    layout = Layout(World(0.0, 0.0, 0.0), 20, {}, {}, {}, {})
    for name, source in (("a", "visual"), ("b", "visual"), ("c", "gnss"), ("d", "waiting"), ("e", "alone")):
        layout = with_frame(layout, name, source, 7 if source == "waiting" else 1)
    assert dict(Homes(layout, ())) == {"a": 1, "b": 1, "c": "c", "d": 7, "e": "e"}
    assert dict(Homes(None, ())) == {}
