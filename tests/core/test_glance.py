"""A glance is all that solving needs of a picture: it says what the thumbnail says, from a fraction of it."""

from __future__ import annotations

import numpy as np
import pytest

from core.exposure import balanced, fitted, shrunk
from core.geometry import Camera, Pose, PosedFrame, World
from core.glance import glance
from core.horizon import shows_sky

CAMERA = Camera(1600, 1200, 1500.0, 799.5, 599.5)
WORLD = World(50.8, -0.1, 30.0)


def thumbs(height: int, width: int, count: int) -> dict[str, np.ndarray]:
    """Waves in colour, each under another light, with a fourth channel that is none."""
    rng = np.random.default_rng(height * width)
    y, x = np.indices((height, width))
    out = {}
    for k in range(count):
        level = (90 + 10 * k + 40 * np.sin(x / 9 + k) * np.cos(y / 7))[..., None] * (1.0, 0.9, 0.8, 0.3)
        out[f"{k:x}"] = (level + rng.normal(0, 6, level.shape)).clip(0, 255).astype(np.uint8)
    return out


@pytest.mark.parametrize(("height", "width"), [(96, 128), (85, 128), (128, 71), (24, 31)])
def test_light_is_balanced_to_the_same_numbers(height: int, width: int) -> None:
    whole = thumbs(height, width, 6)
    down = np.diag([1.0, -1.0, -1.0])
    frames = [
        PosedFrame(name, CAMERA, Pose(down, np.array([4.0 * k, 1.0 * (k % 2), 16.0]), 0.0))
        for k, name in enumerate(whole)
    ]
    little = {k: glance(t).colours for k, t in whole.items()}
    assert balanced(frames, WORLD, little) == balanced(frames, WORLD, whole)
    assert fitted(frames[:2], frames[2:], little) == fitted(frames[:2], frames[2:], whole)
    assert sum(t.nbytes for t in little.values()) <= 6 * 32 * 32 * 3


@pytest.mark.parametrize(("height", "width"), [(96, 128), (85, 128), (24, 31)])
def test_what_was_shrunk_stays_as_it_is(height: int, width: int) -> None:
    for thumb in thumbs(height, width, 2).values():
        assert max(shrunk(thumb).shape) == 32
        assert (shrunk(shrunk(thumb)) == shrunk(thumb)).all()
        assert (shrunk(thumb)[..., :3] == glance(thumb).colours).all()


def test_the_sky_is_looked_for_in_the_whole_thumbnail() -> None:
    ground = thumbs(96, 128, 1)["0"]
    horizon = ground // 2
    horizon[:40, :, :3] = 230
    assert [glance(t).sky for t in (ground, horizon)] == [shows_sky(t) for t in (ground, horizon)]
    assert glance(horizon).sky
    assert not glance(ground).sky
