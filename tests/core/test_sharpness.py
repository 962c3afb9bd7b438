"""A blurred photo, or one of which nobody knows where it was taken, gives way to its neighbours."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from core.features import thumbnail
from core.fusion import render
from core.geometry import Camera, Pose, PosedFrame, World
from core.grid import MercatorGrid
from core.sharpness import give_way, sharpness
from core.warp import FULL, INSIDE

Rgb = NDArray[np.uint8]

WORLD = World(50.8, -0.1, 30.0)
GSD_M = 0.047
CAMERA = Camera(720, 540, 760.0, 359.5, 269.5)
SIDE_PX = 1400


def ground() -> Rgb:
    """Detail of every size down to a few pixels."""
    rng = np.random.default_rng(3)
    out = np.full((SIDE_PX, SIDE_PX, 3), 120.0, np.float32)
    for knots, contrast in ((12, 14), (48, 12), (192, 12), (700, 14)):
        noise = rng.normal(0, contrast, (knots, knots, 3)).astype(np.float32)
        out += cv2.resize(noise, (SIDE_PX, SIDE_PX), interpolation=cv2.INTER_CUBIC)
    return np.clip(out, 20, 235).astype(np.uint8)


class Album:
    """Photos in memory, with the thumbnails that reading them gives."""

    def __init__(self) -> None:
        self.photos: dict[str, Rgb] = {}
        self.shown: set[str] = set()

    def photo(self, frame_id: str) -> Rgb:
        self.shown.add(frame_id)
        return self.photos[frame_id]

    def thumb(self, frame_id: str) -> Rgb:
        photo = self.photos[frame_id]
        return thumbnail(np.asarray(cv2.resize(photo, (544, 408), interpolation=cv2.INTER_AREA), np.uint8))


def flight() -> tuple[list[PosedFrame], Album]:
    """Three lines of three photos straight down, overlapping by 70% both ways; "4" is in the middle."""
    picture, frames, album = ground(), [], Album()
    for n in range(9):
        east, north = (n % 3 - 1) * 10.0, (1 - n // 3) * 7.5
        pose = Pose(
            np.diag([1.0, -1.0, -1.0]), np.array([east, north, 760 * GSD_M]), 0.0, sigma_m=(0.1, 0.1, 0.2)
        )
        frame = PosedFrame(str(n), CAMERA, pose)
        left = east / GSD_M + SIDE_PX / 2 - CAMERA.width / 2
        top = SIDE_PX / 2 - north / GSD_M - CAMERA.height / 2
        shift = np.array([[1, 0, left], [0, 1, top]], np.float32)
        size, flags = (CAMERA.width, CAMERA.height), cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        album.photos[frame.frame_id] = np.asarray(cv2.warpAffine(picture, shift, size, flags=flags), np.uint8)
        frames.append(frame)
    return frames, album


def middle(side_px: int) -> MercatorGrid:
    cols, rows = MercatorGrid(20, 0, 0, 1, 1).from_world(WORLD, [[0.0, 0.0]], 0.0)
    return MercatorGrid(20, int(cols[0]) - side_px // 2, int(rows[0]) - side_px // 2, side_px, side_px)


def edges(picture: Rgb) -> float:
    return float(cv2.Laplacian(picture[..., 1].astype(np.float32), cv2.CV_32F).std())


def motion(px: int) -> NDArray[np.float32]:
    return np.full((1, px), 1 / px, np.float32)


@pytest.mark.parametrize("blur_px", [7, 15])
def test_a_blurred_photo_leaves_no_blurred_patch(blur_px: int) -> None:
    """Where it would have been shown, the mosaic is as sharp as without it, and nowhere is a hole."""
    frames, album = flight()
    grid = middle(160)
    without = edges(render(grid, WORLD, [*frames[:4], *frames[5:]], album))
    album.photos["4"] = np.asarray(cv2.filter2D(album.photos["4"], -1, motion(blur_px)), np.uint8)
    drawn = render(grid, WORLD, frames, album)
    assert (drawn[..., 3] == 255).all()
    assert edges(drawn) > 0.98 * without
    alone = render(grid, WORLD, [frames[4]], album)
    assert edges(alone) < 0.8 * without


def test_a_blurred_photo_is_still_better_than_nothing() -> None:
    frames, album = flight()
    album.photos["4"] = np.asarray(cv2.filter2D(album.photos["4"], -1, motion(9)), np.uint8)
    assert (render(middle(256), WORLD, [frames[4]], album)[..., 3] == 255).all()


def test_a_photo_of_uncertain_place_gives_way() -> None:
    frames, album = flight()
    lost = replace(frames[4], pose=replace(frames[4].pose, sigma_m=(60.0, 60.0, 60.0)))
    grid = middle(96)
    render(grid, WORLD, frames, album)
    assert "4" in album.shown
    album.shown.clear()
    render(grid, WORLD, [*frames[:4], lost, *frames[5:]], album)
    assert "4" not in album.shown
    assert album.shown


def test_sharpness_falls_with_blur_and_with_nothing_else() -> None:
    grey = np.asarray(cv2.cvtColor(ground(), cv2.COLOR_RGB2GRAY)[:408, :544], np.uint8)
    size = (128, 96)
    plain = sharpness(grey, size)
    assert plain.shape == (96, 128)
    assert (plain > 0).all()
    dim = sharpness(np.rint(grey * 0.5 + 40).astype(np.uint8), size)
    assert np.median(np.abs(dim.astype(int) - plain) / plain) < 0.05
    levels = [np.median(sharpness(np.asarray(cv2.GaussianBlur(grey, (0, 0), s)), size)) for s in (0.5, 1, 2)]
    assert np.median(plain) > levels[0] > levels[1] > levels[2]
    assert not sharpness(np.full_like(grey, 80), size).any()


def test_only_what_is_clearly_less_sharp_gives_way() -> None:
    weights = np.full((3, 1, 4), 40_000, np.int32)
    weights[2] = INSIDE - 1
    sharp = np.array([[[100, 100, 100, 0]], [[90, 30, 0, 30]], [[250, 250, 250, 250]]], np.uint8)
    given = weights.copy()
    give_way(weights, sharp)
    assert (weights[:, 0, [0, 2, 3]] == given[:, 0, [0, 2, 3]]).all()
    assert weights[0, 0, 1] == 40_000
    assert INSIDE <= weights[1, 0, 1] < 40_000 / 3
    assert (weights[2] == INSIDE - 1).all()
    far = np.array([[[FULL]], [[FULL // 9]]], np.int32)
    give_way(far, np.array([[[40]], [[200]]], np.uint8))
    assert far[0, 0, 0] == FULL  # the sharper one sees this place from its very edge
