"""A sky is even and bright; ground is not both."""

from __future__ import annotations

import numpy as np
import pytest

from core.geometry import Array, Camera, Pose, World
from core.glance import glance
from core.horizon import shows_sky
from core.mosaic import lay_out
from core.pose_graph import Solution
from core.terrain import Terrain, TerrainParams


def _ground(gsd_m: float = 0.8) -> Array:
    return Terrain(TerrainParams(3)).raster(-200, -200, 128, 96, gsd_m).astype(np.float32)


def _horizon() -> Array:
    picture = _ground() * 0.8
    picture[:40] = np.linspace(225, 205, 40)[:, None, None] + np.random.default_rng(1).normal(
        0, 2, (40, 128, 1)
    )
    return picture


@pytest.mark.parametrize("turns", range(4))
def test_a_horizon_is_seen_whichever_way_the_camera_is_mounted(turns: int) -> None:
    assert shows_sky(np.rot90(_horizon(), turns).clip(0, 255).astype(np.uint8))


@pytest.mark.parametrize("gsd_m", [0.1, 0.3, 0.8])
def test_ground_is_no_sky(gsd_m: float) -> None:
    assert not shows_sky(_ground(gsd_m).clip(0, 255).astype(np.uint8))


@pytest.mark.parametrize("level", [0, 90, 250])
def test_an_even_field_is_no_sky(level: int) -> None:
    assert not shows_sky(np.full((96, 128, 3), level, np.uint8))


def test_only_a_photo_that_ties_to_nothing_is_left_out_for_its_sky() -> None:
    down = np.diag([1.0, -1.0, -1.0])
    poses = {
        name: Pose(down, np.array([20.0 * k, 0.0, 60.0]), 0.0, source)
        for k, (name, source) in enumerate({"tied": "visual", "untied": "gnss", "field": "gnss"}.items())
    }
    camera = Camera(640, 480, 400.0, 319.5, 239.5)
    sky, ground = (p.clip(0, 255).astype(np.uint8) for p in (_horizon(), _ground()))
    thumbs = {"tied": sky, "untied": sky, "field": ground}
    solution = Solution(World(47.0, 15.0), {"c": camera}, poses, {}, 0.0)
    layout = lay_out(solution, dict.fromkeys(poses, "c"), lambda k: glance(thumbs[k]), None)
    assert layout.frames.keys() == {"tied", "field"}
    assert layout.rejected == {"untied": "oblique"}
