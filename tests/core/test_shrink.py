"""A picture that is shrunk keeps its light: every pixel is the mean of the area that it stands for."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from core.shrink import shrinks_by_area, shrunk_by_area

SIDES = st.integers(3, 60).flatmap(lambda n: st.tuples(st.just(n), st.integers(-(-n // 2), n)))


def covered(n: int, m: int) -> np.ndarray:
    """How much of each of `n` pixels lies under each of `m` (m, n), by the interval's two ends."""
    edges = np.linspace(0, n, m + 1)
    under = np.clip(edges[:, None] - np.arange(n), 0, 1)
    return np.diff(under, axis=0) * (m / n)


@settings(deadline=None)  # the first call compiles
@given(SIDES, SIDES, st.integers(0, 2**32 - 1))
def test_every_pixel_is_the_mean_of_its_area(
    across: tuple[int, int], down: tuple[int, int], seed: int
) -> None:
    picture = np.random.default_rng(seed).integers(0, 256, (down[0], across[0], 3), np.uint8)
    small = shrunk_by_area(picture, (across[1], down[1]))
    fair = np.einsum("yh,hwc,xw->yxc", covered(*down), picture.astype(float), covered(*across))
    assert small.shape == (down[1], across[1], 3)
    assert np.abs(small - fair).max() < 0.501


@settings(deadline=None)
@given(st.integers(0, 255), SIDES, SIDES)
def test_one_colour_stays_that_colour(grey: int, across: tuple[int, int], down: tuple[int, int]) -> None:
    picture = np.full((down[0], across[0], 3), grey, np.uint8)
    assert (shrunk_by_area(picture, (across[1], down[1])) == grey).all()


def test_what_shrinks_by_more_than_a_half_is_left_to_others() -> None:
    picture = np.zeros((30, 40, 3), np.uint8)
    assert shrinks_by_area(picture, (20, 15))
    assert shrinks_by_area(picture, (40, 30))
    assert not shrinks_by_area(picture, (19, 15))
    assert not shrinks_by_area(picture, (20, 14))
    assert not shrinks_by_area(picture, (41, 30))
