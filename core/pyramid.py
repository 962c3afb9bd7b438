"""The pyramid of tiles: every overview is the reduction of its four children; and a tile's bytes.

Tiles are RGBA (512, 512, 4) uint8, alpha not premultiplied. Opaque tiles become JPEG, tiles with alpha WebP,
or all of them PNG; fully transparent ones are not stored at all. Equal pixels give equal bytes.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Literal

import cv2
import numpy as np
import simplejpeg
from numpy.typing import NDArray
from PIL import Image

# Else Pillow looks for it in the modules of all its formats: 0.17 s of every worker's first tile with alpha.
from PIL import WebPImagePlugin as WebPImagePlugin

from core.compiled import compiled
from core.grid import TILE_PX
from core.webp import decode_apart

Rgba = NDArray[np.uint8]

JPEG = "image/jpeg"
WEBP = "image/webp"
PNG = "image/png"
QUALITY = 80

TileFormat = Literal["jpeg", "png"]
"""`jpeg`: small: JPEG, where something is transparent WebP. `png`: without loss, several times as large."""


def reduce(children: Sequence[Rgba | None]) -> Rgba:
    """Four tiles NW, NE, SW, SE (None = transparent) → their parent, the alpha-weighted 2 × 2 mean."""
    half = TILE_PX // 2
    out = np.zeros((TILE_PX, TILE_PX, 4), np.uint8)
    for k, child in enumerate(children):
        if child is not None:
            row, col = divmod(k, 2)
            out[row * half :, col * half :][:half, :half] = halve(child)
    return out


def halve(rgba: Rgba) -> Rgba:
    """The 2 × 2 area mean, weighted by alpha, of RGBA (2H, 2W, 4) uint8 → (H, W, 4) uint8."""
    height, width = rgba.shape[0] // 2, rgba.shape[1] // 2
    rgba = np.ascontiguousarray(rgba)
    if _alpha(np.bitwise_and, rgba) == 255:
        # INTER_AREA by exactly 2 is integer: (a + b + c + d + 2) >> 2.
        return np.asarray(cv2.resize(rgba, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
    out = np.empty((height, width, 4), np.uint8)
    _halve(rgba, out)
    return out


def _alpha(together: np.ufunc, rgba: Rgba) -> int:
    """The alphas of all pixels, contiguous in memory, joined bit by bit; read as whole pixels, eight times
    as fast as alone.
    """
    return int(np.asarray(together.reduce(rgba.view(np.uint32), axis=None)).tobytes()[3])


@compiled
def _halve(rgba: Rgba, out: Rgba) -> None:
    for y in range(out.shape[0]):
        for x in range(out.shape[1]):
            a, b = int(rgba[2 * y, 2 * x, 3]), int(rgba[2 * y, 2 * x + 1, 3])
            c, d = int(rgba[2 * y + 1, 2 * x, 3]), int(rgba[2 * y + 1, 2 * x + 1, 3])
            total = a + b + c + d
            out[y, x, 3] = (total + 2) >> 2
            for k in range(3):
                nw, ne = int(rgba[2 * y, 2 * x, k]), int(rgba[2 * y, 2 * x + 1, k])
                sw, se = int(rgba[2 * y + 1, 2 * x, k]), int(rgba[2 * y + 1, 2 * x + 1, k])
                if total == 4 * 255:  # as most pixels are, and the same without a slow division
                    out[y, x, k] = (nw + ne + sw + se + 2) >> 2
                else:
                    whole = a * nw + b * ne + c * sw + d * se
                    out[y, x, k] = (2 * whole + total) // (2 * total) if total else 0


def encode(rgba: Rgba, tile_format: TileFormat = "jpeg") -> tuple[bytes, str] | None:
    """A tile's bytes and media type, None when nothing of it is known."""
    pixels = np.ascontiguousarray(rgba)
    if not _alpha(np.bitwise_or, pixels):
        return None
    opaque = _alpha(np.bitwise_and, pixels) == 255
    if tile_format == "png":
        return _png(pixels, opaque), PNG
    if opaque:
        return simplejpeg.encode_jpeg(
            pixels, quality=QUALITY, colorspace="RGBX", colorsubsampling="420"
        ), JPEG
    out = io.BytesIO()
    # method 1: a third of the bytes less than method 0, which hardly packs the alpha, and three times as fast
    # as the default for a twentieth more.
    Image.fromarray(pixels, "RGBA").save(out, "WEBP", quality=QUALITY, method=1)
    return out.getvalue(), WEBP


def _png(pixels: Rgba, opaque: bool) -> bytes:
    order = cv2.COLOR_RGBA2BGR if opaque else cv2.COLOR_RGBA2BGRA
    # level 1: twice as fast as the default for a twentieth more bytes
    done, data = cv2.imencode(".png", cv2.cvtColor(pixels, order), [cv2.IMWRITE_PNG_COMPRESSION, 1])
    assert done
    return data.tobytes()


def decode(data: bytes) -> Rgba:
    """The inverse of `encode`, as far as its losses allow: a tile's bytes → RGBA (H, W, 4) uint8."""
    if data[:2] == b"\xff\xd8":
        rgba = simplejpeg.decode_jpeg(data, colorspace="RGBA")
        return np.asarray(rgba, np.uint8)
    apart = decode_apart(data)
    if apart is not None:
        return apart
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise ValueError("These bytes are no tile's picture.")
    order = cv2.COLOR_BGRA2RGBA if pixels.shape[2] == 4 else cv2.COLOR_BGR2RGBA
    return np.asarray(cv2.cvtColor(pixels, order), np.uint8)
