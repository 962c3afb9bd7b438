"""A photo's bytes turned into pixels, at full size or smaller, always as the sensor wrote them."""

from __future__ import annotations

import re
from collections.abc import Callable
from io import BytesIO
from typing import Literal

import cv2
import numpy as np
import simplejpeg
from numpy.typing import NDArray
from PIL import JpegImagePlugin, TiffImagePlugin

from core.errors import NotAnImage, TruncatedImage
from core.shrink import shrinks_by_area, shrunk_by_area

Pixels = NDArray[np.uint8]

# libjpeg's words for oddities that some cameras write and that leave the picture whole. More than a sector or
# two of stray bytes is a picture whose other half was never written.
_HARMLESS = re.compile(
    r"\b\d{1,3} extraneous bytes|Unknown Adobe color|Invalid SOS parameters|Inconsistent prog"
)
_JPEG_MAGIC = b"\xff\xd8\xff"
_TIFF_MAGICS = (b"II*\x00", b"MM\x00*")
_ORIENTATION_TAG = 274


def scaled_size(width: int, height: int, max_side: int | None) -> tuple[int, int]:
    """(width, height) with the long side shrunk to `max_side` pixels, never enlarged; None keeps the size."""
    long_side = max(width, height)
    if max_side is None or long_side <= max_side:
        return width, height
    scale = max_side / long_side
    return max(1, round(width * scale)), max(1, round(height * scale))


MILD_SHRINK = 1.5
"""Up to this ratio a picture is made smaller by interpolation: a sample's neighbours still cover its area."""


def decode_rgb(data: bytes, max_side: int | None = None) -> Pixels:
    """JPEG or TIFF bytes → (H, W, 3) uint8 RGB of `scaled_size`, EXIF orientation ignored, alpha dropped.

    Raises NotAnImage, TruncatedImage.
    """
    if data.startswith(_JPEG_MAGIC):
        return _fit(_decode_jpeg(data, max_side, "RGB"), _jpeg_target(data, max_side))
    picture = _decode_tiff(data)
    if picture.ndim == 2:
        picture = np.repeat(picture[..., None], 3, axis=2)
    return _fit(picture, scaled_size(picture.shape[1], picture.shape[0], max_side))


def decode_to_draw(
    data: bytes, max_side: int | None = None, rows_of: Callable[[int, int], int] | None = None
) -> tuple[Pixels, int]:
    """As `decode_rgb`, but up to `MILD_SHRINK` times as large, perhaps its upper part only; the whole height.

    Whoever samples a photo anyway need not have it sampled before. `rows_of`: how many rows are needed of a
    photo so wide and high; a JPEG is not decoded farther down than that.
    """
    if not data.startswith(_JPEG_MAGIC):
        picture = decode_rgb(data, max_side)
        return picture, len(picture)
    width, height, stored = _jpeg_header(data)
    target = scaled_size(width, height, max_side)
    factor = _dct_factor(width, height, target)
    if stored != "YCbCr" or width >= factor * MILD_SHRINK * target[0]:
        picture = _fit(_decode_jpeg(data, max_side, "RGB"), target)
        return picture, len(picture)
    if rows_of is not None:
        rows = factor * rows_of(width // factor, height // factor) + _ROWS_BEYOND
        if rows < height and (part := _decode_top(data, rows // 16 * 16, width, factor)) is not None:
            return part, height // factor
    return _decode_jpeg(data, max_side, "RGB"), height // factor


_ROWS_BEYOND = 48
"""Colours are spread over the rows around them: the last rows of a part are not those of the whole."""


def _decode_top(data: bytes, rows: int, width: int, factor: int) -> Pixels | None:
    """The first rows of a JPEG, which is told to be no higher; None where that cannot be."""
    at = 2
    while (marker := data[at : at + 2]) not in (b"\xff\xc0", b"\xff\xc1"):
        known = marker[:1] == b"\xff" and (
            marker[1:] in b"\xc4\xdb\xdd\xfe" or b"\xe0" <= marker[1:] <= b"\xef"
        )
        if not known:
            return None  # not sequential: what belongs to the first rows is all over the file
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    lower = data[: at + 5] + rows.to_bytes(2, "big") + data[at + 7 :]
    size = {"min_width": width // factor, "min_height": rows // factor} if factor > 1 else {}
    try:
        # Not strict: what follows those rows is noticed.
        pixels = np.asarray(simplejpeg.decode_jpeg(lower, "RGB", strict=False, **size), np.uint8)
    except ValueError:
        return None
    return pixels if pixels.shape[:2] == (rows // factor, width // factor) else None


def decode_gray(data: bytes, max_side: int | None = None) -> Pixels:
    """JPEG or TIFF bytes → (H, W) uint8 luma of `scaled_size`, EXIF orientation ignored.

    Raises NotAnImage, TruncatedImage.
    """
    if data.startswith(_JPEG_MAGIC):
        return _fit(_decode_jpeg(data, max_side, "GRAY"), _jpeg_target(data, max_side))
    picture = _decode_tiff(data)
    if picture.ndim == 3:
        picture = np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), np.uint8)
    return _fit(picture, scaled_size(picture.shape[1], picture.shape[0], max_side))


def _fit(picture: Pixels, size: tuple[int, int]) -> Pixels:
    if (picture.shape[1], picture.shape[0]) == size:
        return np.ascontiguousarray(picture)
    # Areas by odd ratios take longer than the decoding itself, and matter only where a picture shrinks much.
    mild = picture.shape[1] < MILD_SHRINK * size[0]
    if not mild and picture.ndim == 3 and shrinks_by_area(picture, size):
        return shrunk_by_area(picture, size)
    return np.asarray(
        cv2.resize(picture, size, interpolation=cv2.INTER_LINEAR if mild else cv2.INTER_AREA), np.uint8
    )


def _jpeg_header(data: bytes) -> tuple[int, int, str]:
    """(width, height, colour space) of JPEG bytes; "other" is what only Pillow's libjpeg reads."""
    try:
        height, width, colorspace, _ = simplejpeg.decode_jpeg_header(data, strict=False)
    except (ValueError, KeyError):  # KeyError: a chroma subsampling it has no name for
        width, height = _pillow_jpeg(data).size
        return width, height, "other"
    return int(width), int(height), str(colorspace)


def _pillow_jpeg(data: bytes) -> JpegImagePlugin.JpegImageFile:
    # The plugin itself, not Image.open: that one refuses large pictures by a process-wide limit of its own.
    try:
        return JpegImagePlugin.JpegImageFile(BytesIO(data))
    except Exception as error:  # Pillow's plugins raise whatever struct and int do on torn headers
        raise TruncatedImage(_broken(error)) from error


def _jpeg_target(data: bytes, max_side: int | None) -> tuple[int, int]:
    width, height, _ = _jpeg_header(data)
    return scaled_size(width, height, max_side)


def _decode_jpeg(data: bytes, max_side: int | None, colorspace: str) -> Pixels:
    """(H, W, 3) or (H, W) of the target size or a little larger."""
    width, height, stored = _jpeg_header(data)
    if stored not in ("YCbCr", "RGB", "Gray"):
        return _decode_with_pillow(data, "RGB" if colorspace == "RGB" else "L")
    factor = _dct_factor(width, height, scaled_size(width, height, max_side))
    size = {"min_width": width // factor, "min_height": height // factor} if factor > 1 else {}
    try:
        pixels = simplejpeg.decode_jpeg(data, colorspace, strict=True, **size)
    except ValueError as error:
        if not _HARMLESS.search(str(error)):
            raise TruncatedImage(_broken(error)) from error
        pixels = simplejpeg.decode_jpeg(data, colorspace, strict=False, **size)
    return np.asarray(pixels[..., 0] if colorspace == "GRAY" else pixels, np.uint8)


def _broken(error: Exception) -> str:
    return f"The photo's picture data are torn or damaged ({error}). Copy it from the card again."


def _dct_factor(width: int, height: int, target: tuple[int, int]) -> int:
    """How many times the DCT can shrink the picture for free and still be at least the target.

    Only where it divides both sides: else the last column stands for less than a pixel and the scale is off.
    """
    for factor in (8, 4, 2):
        if width % factor == 0 and height % factor == 0 and width // factor >= target[0]:
            return factor
    return 1


def _decode_with_pillow(data: bytes, mode: str) -> Pixels:
    photo = _pillow_jpeg(data)
    try:
        return np.asarray(photo.convert(mode), np.uint8)
    except Exception as error:
        raise TruncatedImage(_broken(error)) from error


def _decode_tiff(data: bytes) -> Pixels:
    """(H, W) or (H, W, 3) uint8 RGB of a TIFF with 8 or 16 bits or floats, alpha dropped."""
    if not data.startswith(_TIFF_MAGICS):
        raise NotAnImage
    try:
        photo = TiffImagePlugin.TiffImageFile(BytesIO(_unrotated(data)))
        photo.load()
    except Exception as error:  # Pillow's plugins raise whatever struct, int and zip do on torn files
        # A torn directory and an exotic kind of pixel cannot be told apart: say both.
        raise TruncatedImage(
            f"The TIFF is torn, or of an unsupported kind of pixel ({error}). Copy it again or export JPEGs."
        ) from error
    if photo.mode in ("L", "LA", "1"):
        return np.asarray(photo.convert("L"), np.uint8)
    if photo.mode == "F" or photo.mode.startswith("I"):
        return _stretched(np.asarray(photo, np.float32))
    return np.asarray(photo if photo.mode == "RGB" else photo.convert("RGB"), np.uint8)


def _unrotated(data: bytes) -> bytes:
    """The same TIFF with EXIF orientation 1: Pillow turns TIFFs by it, out of the sensor's frame."""
    order: Literal["little", "big"] = "little" if data[:1] == b"I" else "big"
    start = int.from_bytes(data[4:8], order)
    for at in range(start + 2, start + 2 + 12 * int.from_bytes(data[start : start + 2], order), 12):
        if int.from_bytes(data[at : at + 2], order) == _ORIENTATION_TAG:
            return data[: at + 8] + (1).to_bytes(2, order) + data[at + 10 :]
    return data


def _stretched(values: NDArray[np.float32]) -> Pixels:
    """A deep grey picture (thermal: 16 bits, floats) in 8 bits, by its own range or it would be all black."""
    values = np.nan_to_num(values, posinf=0.0, neginf=0.0)
    low, high = np.percentile(values, (0.5, 99.5))
    return np.asarray(np.rint(np.clip((values - low) * (255 / max(high - low, 1e-9)), 0, 255)), np.uint8)
