"""Seams run where photos agree: what moves is shown whole or not at all."""

from functools import cache

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from core.fusion import render
from core.geometry import Array, Camera, Pose, PosedFrame, World
from core.grid import MercatorGrid
from core.seams import CONTEST, REACH_CELLS, heaviest, settle
from core.warp import FULL, INSIDE

Rgb = NDArray[np.uint8]

WORLD = World(50.8, -0.1, 30.0)
GSD_M = 0.047
CAMERA = Camera(1080, 810, 760.0, 540.0, 404.0)
WHITE = 250
CAR_M = (4.4, 1.8)
SIDE_PX = 1536


class Album:
    """Photos in memory."""

    def __init__(self) -> None:
        self.photos: dict[str, Rgb] = {}

    def photo(self, frame_id: str) -> Rgb:
        return self.photos[frame_id]

    def thumb(self, frame_id: str) -> Rgb:
        return np.asarray(
            cv2.resize(self.photos[frame_id], (128, 96), interpolation=cv2.INTER_AREA), np.uint8
        )


@cache
def ground() -> Rgb:
    """Grass: smooth, greenish, nowhere near white."""
    rng = np.random.default_rng(4)
    out = np.full((SIDE_PX, SIDE_PX, 3), (95, 125, 80), np.float32)
    for knots, contrast in ((6, 8), (48, 6), (192, 6)):
        noise = rng.normal(0, contrast, (knots, knots, 1)).astype(np.float32)
        out += cv2.resize(noise, (SIDE_PX, SIDE_PX), interpolation=cv2.INTER_CUBIC)[..., None]
    return np.clip(out, 20, 190).astype(np.uint8)


def with_car(picture: Rgb, xy: Array, heading_rad: float) -> Rgb:
    """The ground with a white car, long side along the heading."""
    along = np.array([np.cos(heading_rad), np.sin(heading_rad)])
    aside = np.array([-along[1], along[0]])
    corners = [
        xy + a * CAR_M[0] / 2 * along + b * CAR_M[1] / 2 * aside
        for a, b in ((1, 1), (1, -1), (-1, -1), (-1, 1))
    ]
    px = np.array([(x / GSD_M + SIDE_PX / 2 - 0.5, SIDE_PX / 2 - 0.5 - y / GSD_M) for x, y in corners])
    out = picture.copy()
    cv2.fillConvexPoly(out, np.round(px).astype(np.int32), (WHITE,) * 3)
    return out


def shoot(picture: Rgb, frame: PosedFrame) -> Rgb:
    """What a camera sees that looks straight down."""
    uv = np.array([[0.0, 0.0], [CAMERA.width, 0.0], [0.0, CAMERA.height]])
    x, y = frame.pose.ground(CAMERA, uv)[:, :2].T
    shown = np.column_stack((x / GSD_M + SIDE_PX / 2 - 0.5, SIDE_PX / 2 - 0.5 - y / GSD_M))
    affine = cv2.getAffineTransform(uv.astype(np.float32), shown.astype(np.float32))
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    size = (CAMERA.width, CAMERA.height)
    return np.asarray(
        cv2.warpAffine(picture, affine, size, flags=flags, borderMode=cv2.BORDER_REFLECT), np.uint8
    )


def flight(seed: int, cars: int = 3) -> tuple[list[PosedFrame], Album]:
    """Two lines of three photos, overlapping by half, over cars that drive 12 m from photo to photo."""
    rng, picture = np.random.default_rng(seed), ground()
    starts, headings = rng.uniform(-20, 20, (cars, 2)), rng.uniform(0, 2 * np.pi, cars)
    frames, album = [], Album()
    for n, (east, north) in enumerate(((-20, -9), (0, -9), (20, -9), (20, 9), (0, 9), (-20, 9))):
        yaw = np.pi * (n > 2) + rng.normal(0, 0.1)
        turn = np.array([[np.cos(yaw), np.sin(yaw), 0], [-np.sin(yaw), np.cos(yaw), 0], [0, 0, 1.0]])
        frame = PosedFrame(
            f"{n}", CAMERA, Pose(turn @ np.diag([1.0, -1, -1]), np.array([east, north, 35.0]), 0.0)
        )
        seen = picture
        for start, heading in zip(starts, headings, strict=True):
            seen = with_car(seen, start + 12.0 * n * np.array([np.cos(heading), np.sin(heading)]), heading)
        frames.append(frame)
        album.photos[frame.frame_id] = shoot(seen, frame)
    return frames, album


def middle(width: int, height: int) -> MercatorGrid:
    cols, rows = MercatorGrid(20, 0, 0, 1, 1).from_world(WORLD, [[0.0, 0.0]], 0.0)
    return MercatorGrid(20, int(cols[0]) - width // 2, int(rows[0]) - height // 2, width, height)


def whole_cars(drawn: Rgb) -> list[float]:
    """The areas of the white things that lie wholly in the picture, in cars."""
    white = (drawn[..., :3].min(2) > 200).astype(np.uint8)
    _, _, stats, _ = cv2.connectedComponentsWithStats(white)
    height, width = white.shape
    return [
        area / (CAR_M[0] * CAR_M[1] / GSD_M**2)
        for x, y, w, h, area in stats[1:]
        if x > 0 and y > 0 and x + w < width and y + h < height and area > 30
    ]


@pytest.mark.parametrize("seed", [2, 10, 11, 15, 16, 20])
def test_cars_are_whole_or_absent(seed: int) -> None:
    """Where the heavier photo wins knot by knot, all six flights show parts of cars."""
    frames, album = flight(seed)
    drawn = render(middle(1152, 960), WORLD, frames, album)
    for area in whole_cars(drawn):
        assert abs(area - 1) < 0.06
    # Nor is there a ghost: what is neither car nor edge of a car is grass.
    car = cv2.dilate((drawn[..., :3].min(2) > 200).astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
    grass = drawn[..., 1].astype(int) - drawn[..., 2]
    assert np.percentile(np.abs(grass[~car & (drawn[..., 3] > 0)] - 45), 99.99) < 12


def contest(rows: int = 60, cols: int = 90) -> tuple[NDArray[np.int32], NDArray[np.int16]]:
    """Two photos, the one heavier in the west and the other in the east, that show the same."""
    ramp = np.linspace(0.9, 0.2, cols)
    weights = np.stack([np.tile(INSIDE + (FULL - INSIDE) * w, (rows, 1)) for w in (ramp, ramp[::-1])])
    return weights.astype(np.int32), np.zeros((2, rows, cols, 3), np.int16)


def test_where_photos_agree_the_heavier_one_wins() -> None:
    weights, spots = contest()
    assert np.array_equal(settle(weights, spots).argmax(0), weights.argmax(0))


def test_what_photos_disagree_about_falls_to_one_of_them() -> None:
    weights, spots = contest()
    spots[0, 20:24, 38:49] = 16 * 90
    whose = settle(weights, spots).argmax(0)
    assert len(np.unique(whose[19:25, 37:50])) == 1
    assert len(np.unique(weights.argmax(0)[20:24, 38:49])) == 2
    assert np.array_equal(whose[45:], weights.argmax(0)[45:])


def test_nobody_is_given_ground_beyond_the_photo() -> None:
    weights, spots = contest()
    spots[0] = 16 * 90
    weights[0, :, 40:] = 0
    weights[1, :, :10] = INSIDE - 1
    settled = settle(weights, spots)
    assert not settled[0, :, 40:].any()
    assert (settled[1, :, :10] == INSIDE - 1).all()
    assert (settled[weights >= INSIDE] >= INSIDE).all()


def test_seams_are_the_same_in_every_window() -> None:
    rng = np.random.default_rng(1)
    weights = rng.integers(INSIDE, FULL, (5, 12, 16)).astype(np.float32)
    weights = np.stack([cv2.resize(w, (112, 96), interpolation=cv2.INTER_LINEAR) for w in weights]).astype(
        np.int32
    )
    weights[rng.random((5, 96, 112)) < 0.05] = 0
    spots = (16 * rng.normal(0, 25, (5, 96, 112, 3))).astype(np.int16)
    whole, rim = settle(weights, spots), REACH_CELLS + 2
    moved = (whole.argmax(0) != weights.argmax(0)).mean()
    assert 0.02 < moved < 0.9
    for top, left in ((0, 0), (13, 29), (40, 50)):
        window = np.s_[:, top : top + 56, left : left + 60]
        part = settle(np.ascontiguousarray(weights[window]), np.ascontiguousarray(spots[window]))
        inner = np.s_[:, rim:-rim, rim:-rim]
        assert np.array_equal(part[inner], whole[window][inner])


def test_no_photo_takes_ground_that_it_hardly_sees() -> None:
    weights, spots = contest()
    spots[0] = 16 * 90
    whose = settle(weights, spots).argmax(0)
    own = np.take_along_axis(weights, whose[None], 0)[0].astype(float)
    most = weights.max(0)
    assert ((most - own) <= CONTEST * (most + own) + 1).all()


def test_the_heaviest_photo_wins_and_the_first_of_equals() -> None:
    rng = np.random.default_rng(2)
    weights = rng.integers(0, 5, (6, 40, 70)).astype(np.int32)
    drawn = rng.random((40, 70)) < 0.8
    assert np.array_equal(heaviest(weights, drawn), np.where(drawn, weights.argmax(0), -1))
