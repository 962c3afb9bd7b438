"""A WebP file's colours and its alpha, decoded one after the other, are what they are decoded together."""

import io
from collections.abc import Iterator

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from core.webp import decode_apart

Rgba = NDArray[np.uint8]
Plane = NDArray[np.uint8]

SIZES = [(512, 512), (37, 61), (2, 300), (1, 1)]


def together(data: bytes) -> Rgba:
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert pixels is not None
    return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGRA2RGBA), np.uint8)


def planes(height: int, width: int) -> Iterator[Plane]:
    """Alphas of all kinds: an edge, a soft edge, steps, slopes, noise."""
    rng = np.random.default_rng(height * 1000 + width)
    y, x = np.mgrid[:height, :width]
    yield np.where(3 * x + y > width, 255, 0).astype(np.uint8)
    yield np.clip(3 * (x + y - width / 2), 0, 255).astype(np.uint8)
    yield (x // 3 * 40 % 256).astype(np.uint8)
    yield (y * 7 % 256).astype(np.uint8)
    yield np.clip(x * 255 / width + y * 255 / height - 128, 0, 255).astype(np.uint8)
    yield rng.integers(0, 256, (height, width)).astype(np.uint8)


def picture(alpha: Plane) -> Rgba:
    rng = np.random.default_rng(alpha.size)
    rgb = cv2.resize(
        rng.integers(0, 256, (9, 9, 3)).astype(np.uint8), alpha.shape[::-1], interpolation=cv2.INTER_LINEAR
    )
    out = np.dstack((rgb, alpha)).astype(np.uint8)
    if alpha.size > 1:
        out[0, 0, 3] = 128  # an opaque picture has no alpha in its file
    return np.asarray(out, np.uint8)


def saved(rgba: Rgba, **options: object) -> bytes:
    out = io.BytesIO()
    Image.fromarray(rgba).save(out, "WEBP", **options)
    return out.getvalue()


def chunk(name: bytes, data: bytes) -> bytes:
    return name + len(data).to_bytes(4, "little") + data + bytes(len(data) % 2)


def found(data: bytes, name: bytes) -> bytes:
    at = data.index(name)
    return data[at + 8 :][: int.from_bytes(data[at + 4 : at + 8], "little")]


@pytest.mark.parametrize(("height", "width"), SIZES)
@pytest.mark.parametrize("method", [0, 1, 4])
def test_apart_is_as_together(height: int, width: int, method: int) -> None:
    for alpha in planes(height, width):
        rgba = picture(alpha)
        if rgba[..., 3].min() == 255:
            continue
        data = saved(rgba, quality=80, method=method)
        apart = decode_apart(data)
        assert apart is not None
        assert np.array_equal(apart, together(data))
        assert np.array_equal(apart[..., 3], rgba[..., 3])


def residue(alpha: Plane, method: int) -> Plane:
    """How each pixel differs from what RFC 9649 (2.7.1.2) foretells of it."""
    a = alpha.astype(int)
    out = np.zeros_like(a)
    for y, x in np.ndindex(a.shape):
        left, above = a[y, x - 1] if x else 0, a[y - 1, x] if y else 0
        if y == 0 or x == 0:
            foretold = left if x else above
        else:
            foretold = (left, above, int(np.clip(left + above - a[y - 1, x - 1], 0, 255)))[method - 1]
        out[y, x] = a[y, x] - (foretold if method else 0)
    return (out & 255).astype(np.uint8)


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("method", [0, 1, 2, 3])
def test_alpha_may_be_foretold_in_any_way_and_packed_or_not(method: int, packed: bool) -> None:
    for alpha in planes(37, 61):
        rest = residue(alpha, method)
        if packed:
            green = np.zeros((*rest.shape, 3), np.uint8)
            green[..., 1] = rest
            stored = found(saved(green, lossless=True), b"VP8L")[5:]
        else:
            stored = rest.tobytes()
        size = (alpha.shape[1] - 1).to_bytes(3, "little") + (alpha.shape[0] - 1).to_bytes(3, "little")
        body = chunk(b"VP8X", b"\x10\0\0\0" + size)
        body += chunk(b"ALPH", bytes([method << 2 | packed]) + stored)
        body += chunk(b"VP8 ", found(saved(picture(alpha)[..., :3], quality=80), b"VP8 "))
        data = b"RIFF" + (4 + len(body)).to_bytes(4, "little") + b"WEBP" + body
        apart = decode_apart(data)
        assert apart is not None
        assert np.array_equal(apart[..., 3], alpha)
        assert np.array_equal(apart, together(data))


def test_other_files_are_left_to_the_ordinary_decoder() -> None:
    rgba = picture(next(planes(37, 61)))
    whole = saved(rgba, quality=80)
    assert decode_apart(whole) is not None
    for part in range(0, len(whole) - 1, 7):
        assert decode_apart(whole[:part]) is None
    assert decode_apart(saved(rgba, lossless=True)) is None
    assert decode_apart(saved(rgba[..., :3], quality=80)) is None
    assert decode_apart(whole.replace(b"ALPH", b"ALPX")) is None
    assert decode_apart(b"\xff\xd8\xff" + bytes(400)) is None
