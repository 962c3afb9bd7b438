"""What a photo's header says, read without decoding a single pixel."""

from __future__ import annotations

from dataclasses import dataclass
from io import SEEK_CUR, SEEK_END, BytesIO
from typing import BinaryIO

from PIL import JpegImagePlugin, TiffImagePlugin

from core.errors import EmptyFile, FileTooLarge, NotAnImage, TooFewPixels, TooManyPixels, TruncatedImage

_WIDTH_TAG, _HEIGHT_TAG = 256, 257
_JPEG_MAGIC = b"\xff\xd8\xff"
_TIFF_MAGICS = (b"II*\x00", b"MM\x00*")
_FRAMES, _SCAN = (0xC0, 0xC1, 0xC2), 0xDA  # JPEG: where the size stands, and where the picture begins
_SKIPPED = (0xC4, 0xDB, 0xDD, *range(0xE0, 0xF0), 0xFE)


@dataclass(frozen=True, slots=True)
class PhotoLimits:
    """What a photo may be at most, and at least, before anybody spends memory on it."""

    max_bytes: int = 200_000_000
    max_pixels: int = 200_000_000
    min_side_px: int = 64


@dataclass(frozen=True, slots=True)
class PhotoHeader:
    """Format ("JPEG" or "TIFF"), pixels as the sensor wrote them (EXIF orientation ignored), media type."""

    format: str
    width: int
    height: int
    media_type: str


def probe(data: bytes, limits: PhotoLimits = PhotoLimits()) -> PhotoHeader:
    """The header of a photo's bytes; a drone's MPO (a JPEG with a second picture behind it) is a JPEG.

    Raises EmptyFile, FileTooLarge, NotAnImage, TruncatedImage, TooManyPixels, TooFewPixels.
    """
    return probe_file(BytesIO(data), limits)


def probe_file(photo: BinaryIO, limits: PhotoLimits = PhotoLimits()) -> PhotoHeader:
    """As `probe`, of a stream that can be sought in: no more than the header of it is read."""
    size_bytes = photo.seek(0, SEEK_END)
    if not size_bytes:
        raise EmptyFile
    if size_bytes > limits.max_bytes:
        raise FileTooLarge(
            f"The file has {size_bytes / 1e6:.0f} MB, more than the limit of "
            f"{limits.max_bytes / 1e6:.0f} MB. Export a smaller JPEG of it."
        )
    header = _header(photo, size_bytes)
    _check_size(header, limits)
    return header


def _header(photo: BinaryIO, size_bytes: int) -> PhotoHeader:
    photo.seek(0)
    start = photo.read(8)
    photo.seek(0)
    if start.startswith(_JPEG_MAGIC):
        return PhotoHeader("JPEG", *_jpeg_size(photo), "image/jpeg")
    if start.startswith(_TIFF_MAGICS):
        return PhotoHeader("TIFF", *_tiff_size(photo, start, size_bytes), "image/tiff")
    # A copy cut within the first bytes is a torn photo, not a foreign file.
    if any(magic.startswith(start) for magic in (_JPEG_MAGIC, *_TIFF_MAGICS)):
        raise TruncatedImage
    raise NotAnImage


def _jpeg_size(photo: BinaryIO) -> tuple[int, int]:
    size = _orderly_size(photo)
    if size is not None:
        return size
    photo.seek(0)
    # The plugin itself, not Image.open: that one warns or raises by a process-wide pixel limit of its own.
    try:
        width, height = JpegImagePlugin.JpegImageFile(photo).size
    except Exception as error:  # Pillow's plugins raise whatever struct, int and zip do on torn headers
        raise TruncatedImage from error
    return width, height


def _orderly_size(photo: BinaryIO) -> tuple[int, int] | None:
    """Of a JPEG whose segments are in order up to where its picture begins; None: Pillow has to judge it."""
    size = None
    photo.seek(2)
    while len(head := photo.read(4)) == 4 and head[0] == 0xFF:
        marker, length = head[1], int.from_bytes(head[2:], "big") - 2
        if marker == _SCAN:
            return size
        if marker in _FRAMES:
            frame = photo.read(length)
            if len(frame) < 6 or frame[0] != 8 or frame[5] not in (1, 3, 4):
                return None
            size = int.from_bytes(frame[3:5], "big"), int.from_bytes(frame[1:3], "big")
        elif marker in _SKIPPED and length >= 0:
            photo.seek(length, SEEK_CUR)
        else:
            return None
    return None


def _tiff_size(photo: BinaryIO, start: bytes, size_bytes: int) -> tuple[int, int]:
    # The directory alone: Pillow's TIFF plugin refuses pixel types that the decoder can read.
    try:
        directory = TiffImagePlugin.ImageFileDirectory_v2(start)
        if directory.next < 8 or directory.next >= size_bytes:
            raise TruncatedImage
        photo.seek(directory.next)
        directory.load(photo)
        return int(directory[_WIDTH_TAG]), int(directory[_HEIGHT_TAG])
    except Exception as error:
        raise TruncatedImage from error


def _check_size(header: PhotoHeader, limits: PhotoLimits) -> None:
    pixels = header.width * header.height
    if pixels > limits.max_pixels:
        raise TooManyPixels(
            f"The photo has {header.width} × {header.height} pixels, more than the limit of "
            f"{limits.max_pixels / 1e6:.0f} million. Export a smaller JPEG of it."
        )
    if min(header.width, header.height) < limits.min_side_px:
        raise TooFewPixels(
            f"The photo has {header.width} × {header.height} pixels, too few to be matched (at least "
            f"{limits.min_side_px} a side). Upload the original, not its thumbnail."
        )
