"""Blur in a few taps, held against OpenCV's in as many as it takes, and by what blurs do."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from core.blurring import blur

Floats = np.ndarray


def picture(blurred_px: float, shape: tuple[int, int] = (90, 130)) -> Floats:
    noise = np.random.default_rng(4).normal(0, 100, shape).astype(np.float32)
    return np.asarray(cv2.GaussianBlur(noise, (0, 0), blurred_px), np.float32)


def blurred(sharp: Floats, sigma: float) -> Floats:
    out = np.empty_like(sharp)
    blur(sharp, sigma, out)
    return out


@pytest.mark.parametrize("sigma", [0.7, 1.0, 1.25, 1.33, 1.6, 2.5, 3.1, 3.9])
@pytest.mark.parametrize("shape", [(90, 130), (17, 300), (300, 17)])
def test_few_taps_blur_as_many_do(sigma: float, shape: tuple[int, int]) -> None:
    sharp = picture(sigma / 0.8, shape)
    expected = cv2.GaussianBlur(sharp, (0, 0), sigma)
    assert np.abs(blurred(sharp, sigma) - expected).max() < 2e-3 * np.abs(sharp).max()


@pytest.mark.parametrize(("first", "second"), [(1.25, 1.25), (1.6, 1.2), (2.0, 3.0)])
def test_two_blurs_are_one_of_both_variances(first: float, second: float) -> None:
    sharp = picture(4.0)
    twice = blurred(blurred(sharp, first), second)
    once = blurred(sharp, float(np.hypot(first, second)))
    assert np.abs(twice - once).max() < 2e-3 * np.abs(sharp).max()


def test_a_picture_of_one_grey_keeps_it_to_its_border() -> None:
    assert np.abs(blurred(np.full((20, 40), 93, np.float32), 3.0) - 93).max() < 1e-4


def test_a_blur_that_reaches_beyond_the_picture_is_refused() -> None:
    with pytest.raises(ValueError, match="too small"):
        blurred(np.zeros((12, 40), np.float32), 3.0)
