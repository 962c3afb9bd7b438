"""Compiles and loads, before the pool forks, what every process needs: shared memory, no slow first photo."""

from __future__ import annotations

import numpy as np

from core.coverage import draw_block, mission_zoom, quarter, tiles_under
from core.exposure import balanced
from core.features import FeatureParams, Features, extract
from core.frame import Attitude, FrameMeta, GpsFix
from core.fusion import FrameIndex
from core.geometry import Array, Camera, Pose, PosedFrame, World
from core.grid import TILE_PX
from core.matching import MatchCounts, MatchParams, PairMatch, match_pair
from core.pyramid import Rgba, encode
from core.shrink import shrunk_by_area

HEIGHT_M, STEP_M, SIDE_PX = 60.0, 12.0, 256
FRAMES = 34
"""More than are solved as one dense matrix."""
NORTH_UP_DOWN = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
WORLD = World(47.0, 8.0, 400.0)


class _Chequered:
    """Photos of nothing in particular."""

    def photo(self, frame_id: str) -> Rgba:
        rows, cols = np.indices((SIDE_PX * 3 // 4, SIDE_PX))
        grey = ((rows // 8 + cols // 8) % 2 * 120 + rows % 97).astype(np.uint8)
        return np.ascontiguousarray(np.repeat(grey[..., None], 3, axis=2))

    def thumb(self, frame_id: str) -> Rgba:
        return np.ascontiguousarray(self.photo(frame_id)[::2, ::2])


def _camera() -> Camera:
    return _meta(0).camera()


def _center(k: int) -> Array:
    return np.array([STEP_M * (k % 3), STEP_M * (k // 3), HEIGHT_M])


def _meta(k: int) -> FrameMeta:
    lon, lat, alt = WORLD.to_geodetic(_center(k)[None])[0]
    fix = GpsFix(float(lat), float(lon), float(alt))
    height = SIDE_PX * 3 // 4
    return FrameMeta(SIDE_PX, height, 200.0, 1.7e9 + k, fix, HEIGHT_M, Attitude(0.0), "drone", "body")


def _matching() -> None:
    rng, count = np.random.default_rng(0), 2 * MatchParams().strongest
    found = Features(
        keypoints=rng.uniform(0, SIDE_PX * 3 // 4, (count, 2)).astype(np.float32),
        angle_rad=np.zeros(count, np.float32),
        scale_px=np.ones(count, np.float32),
        descriptors=rng.integers(0, 100, (count, 128)).astype(np.uint8),
        words=np.zeros(1, np.float32),
        thumb=np.zeros((1, 1, 4), np.uint8),
    )
    match_pair("0", found, "1", found, _camera(), _camera())


def rendering() -> None:
    """Features, matching, rendering, encoding."""
    photos = _Chequered()
    _matching()
    shrunk_by_area(photos.photo("0"), (SIDE_PX // 2, SIDE_PX * 3 // 8))
    extract(photos.photo("0"), (SIDE_PX, SIDE_PX), FeatureParams())
    frames = [
        PosedFrame(str(k), _camera(), Pose(NORTH_UP_DOWN, _center(k), 0.0), (1.0, 1.01, 1.02))
        for k in range(2)
    ]
    frames = balanced(frames, WORLD, {f.frame_id: photos.thumb(f.frame_id) for f in frames})
    zoom = mission_zoom(frames, WORLD, None)
    assert zoom is not None
    tiles = sorted(tiles_under(frames[0], WORLD, zoom))
    draw_block(tiles[:2], WORLD, FrameIndex(frames), photos)
    border = encode(_border_tile())
    assert border is not None
    quarter(border[0])


def _border_tile() -> Rgba:
    """Its alpha rises evenly, so that the file says how each pixel differs from what was foretold."""
    rgba = np.full((TILE_PX, TILE_PX, 4), 200, np.uint8)
    rgba[..., 3] = np.indices((TILE_PX, TILE_PX)).sum(0) // 2 % 256
    return rgba


def solving() -> None:
    """The pose graph, and placing a frame in it."""
    from core.pose_graph import GraphFrame, place, solve

    frames = [GraphFrame(f"{k:032x}", f"{k}.jpg", _meta(k)) for k in range(FRAMES)]
    matches = [_match(k - step, k) for k in range(FRAMES) for step in (3, 1) if k >= step]
    last = frames[-1].frame_id
    solution = solve(frames[:-1], [m for m in matches if m.high != last])
    place(solution, {f.frame_id: f for f in frames}, [last], matches)


def _match(i: int, j: int) -> PairMatch:
    """What two frames would see of the same flat ground."""
    camera = _camera()
    a, b = (Pose(NORTH_UP_DOWN, _center(k), 0.0) for k in (i, j))
    xs, ys = np.meshgrid(np.linspace(20, SIDE_PX - 20, 9), np.linspace(20, SIDE_PX * 0.7, 9))
    uv = np.column_stack((xs.ravel(), ys.ravel()))
    other = b.pixels(camera, a.ground(camera, uv))
    seen = ((other > 0) & (other < (camera.width, camera.height))).all(1)
    uv_low, uv_high = uv[seen].astype(np.float32), other[seen].astype(np.float32)
    return PairMatch(
        f"{i:032x}", f"{j:032x}", True, "ok", uv_low, uv_high, MatchCounts(final=int(seen.sum()))
    )
