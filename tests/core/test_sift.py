"""SIFT: against OpenCV's own, and by what it must not notice: a turned, shifted or brighter picture."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import pytest

from core.sift import Described, ScaleSpace, describe, find_spots, scale_space

Gray = np.ndarray


@cache
def ground(height: int = 240, width: int = 320, seed: int = 1) -> Gray:
    """Noise of many sizes, uint8 (height, width)."""
    rng = np.random.default_rng(seed)
    picture = np.zeros((height, width), np.float32)
    for sigma in (1.2, 2.5, 5, 11, 23):
        layer = cv2.GaussianBlur(rng.normal(size=picture.shape).astype(np.float32), (0, 0), sigma)
        picture += layer / layer.std()
    return (128 + 28 * picture).clip(0, 255).astype(np.uint8)


def keypoints(gray: Gray, most: int = 10_000) -> Described:
    space = scale_space(gray, 3)
    return describe(space, find_spots(space, 0.01), most)


def unit(histograms: np.ndarray) -> np.ndarray:
    return np.asarray(histograms / np.linalg.norm(histograms, axis=1, keepdims=True))


def partners(a: Described, xy: np.ndarray, angle_rad: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows of `a`, and of (xy, angle): each row of `a` with the nearest within half a pixel and 0.1 rad."""
    away = np.linalg.norm(a.xy[:, None] - xy[None], axis=2)
    turned = np.abs((a.angle_rad[:, None] - angle_rad[None] + np.pi) % (2 * np.pi) - np.pi)
    cost = np.where((away < 0.5) & (turned < 0.1), away, np.inf)
    found = np.flatnonzero(np.isfinite(cost.min(1)))
    return found, cost[found].argmin(1)


def test_finds_and_describes_what_opencv_does() -> None:
    sift = cv2.SIFT.create(0, 3, 0.01, 10, 1.6, enable_precise_upscale=True)
    theirs, histograms = sift.detectAndCompute(ground(), None)
    xy = np.array([k.pt for k in theirs])
    mine = keypoints(ground())
    i, j = partners(mine, xy, np.radians([k.angle for k in theirs]))
    away = np.linalg.norm(xy[:, None] - mine.xy[None], axis=2)
    assert (away.min(1) < 0.3).mean() > 0.9
    assert len(np.unique(j)) > 0.75 * len(theirs)
    assert np.abs((mine.xy[i] - xy[j]).mean(0)).max() < 0.01
    assert np.median((unit(mine.histograms[i]) * unit(histograms[j])).sum(1)) > 0.98
    assert abs(np.median(mine.size_px[i] / np.array([k.size for k in theirs])[j]) - 1) < 0.02


@pytest.mark.parametrize("quarter_turns", [1, 2, 3])
def test_a_turned_picture_has_the_same_keypoints_turned(quarter_turns: int) -> None:
    gray = ground()
    a, b = keypoints(gray), keypoints(np.ascontiguousarray(np.rot90(gray, -quarter_turns)))
    turn = quarter_turns * np.pi / 2  # clockwise
    c, s = np.cos(turn), np.sin(turn)
    middle = np.array([(gray.shape[1] - 1) / 2, (gray.shape[0] - 1) / 2])
    after = middle if quarter_turns == 2 else middle[::-1]
    expected = (a.xy - middle) @ np.array([[c, s], [-s, c]]) + after
    i, j = partners(b, expected, (a.angle_rad + turn) % (2 * np.pi))
    assert len(i) > 0.85 * len(b.xy)
    assert np.median((unit(b.histograms[i]) * unit(a.histograms[j])).sum(1)) > 0.98


def test_contrast_and_brightness_change_no_histogram() -> None:
    soft = (ground() * 0.5 + 40).astype(np.uint8)
    a, b = keypoints(ground()), keypoints(soft)
    i, j = partners(b, a.xy, a.angle_rad)
    assert len(i) > 0.8 * len(b.xy)
    assert np.median((unit(b.histograms[i]) * unit(a.histograms[j])).sum(1)) > 0.99


@pytest.mark.parametrize("sigma", [3.0, 5.0, 8.0])
def test_a_blob_is_found_at_its_place_with_its_size(sigma: float) -> None:
    y, x = np.mgrid[0:240, 0:320]
    blob = 200 - 150 * np.exp(-((x - 151.3) ** 2 + (y - 120.6) ** 2) / (2 * sigma**2))
    found = keypoints(blob.astype(np.uint8))
    near = np.linalg.norm(found.xy - (151.3, 120.6), axis=1)
    assert near.min() < 0.15
    assert found.size_px[near.argmin()] == pytest.approx(2 * sigma, rel=0.12)


def test_the_first_spots_are_described_when_there_are_too_many() -> None:
    space = scale_space(ground(), 3)
    spots = find_spots(space, 0.01)
    backwards = spots.take(np.arange(len(spots.response))[::-1])
    few, every = describe(space, backwards, 50), describe(space, backwards, 10_000)
    assert len(few.xy) == 50
    assert np.array_equal(few.xy, every.xy[:50])
    assert np.array_equal(few.histograms, every.histograms[:50])
    assert np.array_equal(few.xy[0], backwards.xy()[0])


@pytest.mark.parametrize("shape", [(1, 1), (3, 200), (240, 320)])
def test_a_picture_without_anything_has_no_keypoints(shape: tuple[int, int]) -> None:
    found = keypoints(np.full(shape, 90, np.uint8))
    assert found.xy.shape == (0, 2)
    assert found.histograms.shape == (0, 128)


def test_blur_rises_by_the_same_factor_from_layer_to_layer() -> None:
    point = np.zeros((200, 200), np.uint8)
    point[100, 100] = 255
    space: ScaleSpace = scale_space(point, 3)
    y, x = np.mgrid[0:400, 0:400]
    for k, layer in enumerate(space.octaves[0]):
        share = layer / layer.sum()
        at = (share * x).sum(), (share * y).sum()
        spread = np.sqrt((share * ((x - at[0]) ** 2 + (y - at[1]) ** 2)).sum() / 2)
        # blurred by one pixel less, since a point has not been through a lens, but drawn twice as large
        assert spread == pytest.approx(np.sqrt((1.6 * 2 ** (k / 3)) ** 2 - 1 + 0.75), rel=0.03)
