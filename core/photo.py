"""What a photo's header says, read without decoding a single pixel."""

from __future__ import annotations

from dataclasses import dataclass
from io import BytesIO

from PIL import JpegImagePlugin, TiffImagePlugin

from core.errors import EmptyFile, FileTooLarge, NotAnImage, TooFewPixels, TooManyPixels, TruncatedImage

_WIDTH_TAG, _HEIGHT_TAG = 256, 257
_JPEG_MAGIC = b"\xff\xd8\xff"
_TIFF_MAGICS = (b"II*\x00", b"MM\x00*")


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
    if not data:
        raise EmptyFile
    if len(data) > limits.max_bytes:
        raise FileTooLarge(
            f"The file has {len(data) / 1e6:.0f} MB, more than the limit of {limits.max_bytes / 1e6:.0f} MB. "
            "Export a smaller JPEG of it."
        )
    header = _header(data)
    _check_size(header, limits)
    return header


def _header(data: bytes) -> PhotoHeader:
    if data.startswith(_JPEG_MAGIC):
        return PhotoHeader("JPEG", *_jpeg_size(data), "image/jpeg")
    if data.startswith(_TIFF_MAGICS):
        return PhotoHeader("TIFF", *_tiff_size(data), "image/tiff")
    # A copy cut within the first bytes is a torn photo, not a foreign file.
    if any(magic.startswith(data) for magic in (_JPEG_MAGIC, *_TIFF_MAGICS)):
        raise TruncatedImage
    raise NotAnImage


def _jpeg_size(data: bytes) -> tuple[int, int]:
    # The plugin itself, not Image.open: that one warns or raises by a process-wide pixel limit of its own.
    try:
        width, height = JpegImagePlugin.JpegImageFile(BytesIO(data)).size
    except Exception as error:  # Pillow's plugins raise whatever struct, int and zip do on torn headers
        raise TruncatedImage from error
    return width, height


def _tiff_size(data: bytes) -> tuple[int, int]:
    # The directory alone: Pillow's TIFF plugin refuses pixel types that the decoder can read.
    try:
        directory = TiffImagePlugin.ImageFileDirectory_v2(data[:8])
        if directory.next < 8 or directory.next >= len(data):
            raise TruncatedImage
        stream = BytesIO(data)
        stream.seek(directory.next)
        directory.load(stream)
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
