"""Overviews are reductions of their children, and tiles survive being encoded."""

import numpy as np
import pytest
from numpy.typing import NDArray

from core.pyramid import JPEG, PNG, WEBP, decode, encode, halve, reduce

Rgba = NDArray[np.uint8]


def tile(seed: int, alpha: str = "opaque") -> Rgba:
    rng = np.random.default_rng(seed)
    coarse = rng.integers(0, 256, (17, 17, 4)).astype(float)
    at = np.linspace(0, 16, 512)
    low = np.minimum(at.astype(int), 15)
    f = (at - low)[:, None, None]
    rows = coarse[low] * (1 - f) + coarse[low + 1] * f
    f = (at - low)[None, :, None]
    out = (rows[:, low] * (1 - f) + rows[:, low + 1] * f).astype(np.uint8)
    if alpha == "opaque":
        out[..., 3] = 255
    elif alpha == "edge":
        out[..., 3] = np.where(np.add.outer(np.arange(512), 3 * np.arange(512)) > 700, 255, 0)
        out[out[..., 3] == 0] = 0
    return np.asarray(out, np.uint8)


def by_hand(quad: NDArray[np.int64]) -> list[int]:
    """The reduction of four RGBA pixels in whole numbers."""
    total = int(quad[:, 3].sum())
    if total == 0:
        return [0, 0, 0, 0]
    colour = [(2 * int((quad[:, c] * quad[:, 3]).sum()) + total) // (2 * total) for c in range(3)]
    return [*colour, (total + 2) // 4]


@pytest.mark.parametrize("alpha", ["opaque", "edge", "soft"])
def test_a_parent_is_the_weighted_mean_of_its_children(alpha: str) -> None:
    kids = [tile(k, alpha) for k in range(4)]
    up = reduce(kids)
    assert up.shape == (512, 512, 4)
    rng = np.random.default_rng(9)
    for row, col in rng.integers(0, 512, (400, 2)):
        kid = kids[2 * (row // 256) + col // 256]
        y, x = 2 * (row % 256), 2 * (col % 256)
        assert up[row, col].tolist() == by_hand(kid[y : y + 2, x : x + 2].reshape(4, 4).astype(np.int64))


def test_nothing_known_stays_transparent_and_bleeds_nowhere() -> None:
    white = np.full((512, 512, 4), 255, np.uint8)
    up = reduce([white, None, None, white])
    assert (up[:256, :256] == 255).all()
    assert (up[256:, 256:] == 255).all()
    assert not up[:256, 256:].any()
    half = white.copy()
    half[:, 1::2] = 0
    assert np.unique(halve(half).reshape(-1, 4), axis=0).tolist() == [[255, 255, 255, 128]]
    assert not reduce([None] * 4).any()


def test_opaque_is_jpeg_and_the_rest_webp() -> None:
    for seed in range(3):
        data, kind = encode(tile(seed)) or (b"", "")
        assert kind == JPEG
        assert data[:3] == b"\xff\xd8\xff"
        back = decode(data)
        assert (back[..., 3] == 255).all()
        assert np.abs(back[..., :3].astype(int) - tile(seed)[..., :3]).mean() < 4
        ragged = tile(seed, "edge")
        data, kind = encode(ragged) or (b"", "")
        assert kind == WEBP
        assert data[8:12] == b"WEBP"
        back = decode(data)
        assert (back[..., 3] == ragged[..., 3]).all()
        seen = ragged[..., 3] > 0
        assert np.abs(back[..., :3].astype(int) - ragged[..., :3])[seen].mean() < 5
    assert encode(np.zeros((512, 512, 4), np.uint8)) is None


@pytest.mark.parametrize("alpha", ["opaque", "edge"])
def test_png_loses_nothing_and_half_of_it_is_half_of_the_picture(alpha: str) -> None:
    picture = tile(4, alpha)
    data, kind = encode(picture, "png") or (b"", "")
    assert (kind, data[:4]) == (PNG, b"\x89PNG")
    assert (decode(data) == picture).all()
    assert (data, kind) == encode(picture.copy(), "png")
    assert (halve(decode(data)) == halve(picture)).all()
    assert encode(np.zeros_like(picture), "png") is None


def test_one_visible_pixel_is_enough() -> None:
    lonely = np.zeros((512, 512, 4), np.uint8)
    lonely[100, 200] = (10, 200, 30, 255)
    encoded = encode(lonely)
    assert encoded is not None
    assert decode(encoded[0])[100, 200, 3] == 255


def test_one_pixel_that_is_not_opaque_is_enough() -> None:
    for alpha in (254, 127, 0):
        leaky = tile(3)
        leaky[511, 0, 3] = alpha
        encoded = encode(leaky)
        assert encoded is not None
        assert encoded[1] == WEBP
        assert halve(leaky)[255, 0, 3] == (3 * 255 + alpha + 2) // 4
        faint = np.zeros((512, 512, 4), np.uint8)
        faint[0, 511, 3] = alpha
        assert (encode(faint) is None) == (alpha == 0)


def test_equal_pixels_give_equal_bytes() -> None:
    canvas = np.zeros((512, 1024, 4), np.uint8)
    for alpha in ("opaque", "edge"):
        canvas[:, 512:] = tile(5, alpha)
        assert encode(canvas[:, 512:]) == encode(tile(5, alpha))
        assert (reduce([canvas[:, 512:]] * 4) == reduce([tile(5, alpha)] * 4)).all()
