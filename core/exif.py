"""The EXIF and XMP blocks of a photo, found and unpacked; what they mean is `core.metadata`'s business."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from io import BytesIO
from typing import Any

from PIL import Image

from core.xmp import parse_xmp

_EXIF_HEAD = b"Exif\x00\x00"
_XMP_HEAD = b"http://ns.adobe.com/xap/1.0/\x00"
_EXIF_IFD, _GPS_IFD, _MAKER_NOTE, _TIFF_XMP = 0x8769, 0x8825, 0x927C, 700
_FLOAT_TYPE = 11


@dataclass(frozen=True, slots=True)
class Tags:
    """The raw tags of one photo by EXIF number; `dji` are the maker notes of older DJI cameras."""

    image: Mapping[int, Any] = field(default_factory=dict)
    exif: Mapping[int, Any] = field(default_factory=dict)
    gps: Mapping[int, Any] = field(default_factory=dict)
    dji: Mapping[int, float] = field(default_factory=dict)
    xmp: Mapping[str, str] = field(default_factory=dict)


def read_tags(data: bytes) -> Tags:
    """Every tag of a JPEG's or TIFF's bytes that can be read; on garbage fewer, or none. Never raises."""
    exif_block, xmp_packet = _blocks(data)
    directory = Image.Exif()
    try:
        if exif_block:
            directory.load(exif_block)
        elif data[:2] in (b"II", b"MM"):
            directory.load_from_fp(BytesIO(data))
            xmp_packet = _bytes(directory.get(_TIFF_XMP))
    except Exception:  # Pillow raises whatever struct, int and decode do on broken directories
        directory = Image.Exif()
    exif = _directory(directory, _EXIF_IFD)
    return Tags(
        image=dict(_items(directory)),
        exif=exif,
        gps=_directory(directory, _GPS_IFD),
        dji=_dji_maker_note(_bytes(exif.get(_MAKER_NOTE))),
        xmp=parse_xmp(xmp_packet) if xmp_packet else {},
    )


def number(value: Any) -> float | None:
    """A tag's value (rational, number or text such as "+39.80" or "398/10") as a finite float, or None."""
    try:
        if isinstance(value, bytes):
            value = value.decode("ascii")
        if isinstance(value, str):
            above, _, below = value.strip("\x00 ").partition("/")
            value = float(above) / float(below) if below else float(above)
        elif isinstance(value, tuple | list):
            return number(value[0])
        result = float(value)
    except (TypeError, ValueError, ArithmeticError, IndexError):
        return None
    return result if math.isfinite(result) else None


def text(value: Any, limit: int = 48) -> str:
    """A tag's value as one short printable line, "" when it holds none."""
    if isinstance(value, bytes):
        value = value.decode("utf-8", "replace")
    if not isinstance(value, str | int):
        return ""
    line = str(value).partition("\x00")[0]
    return " ".join("".join(c if c.isprintable() and c != "�" else " " for c in line).split())[:limit]


def _blocks(data: bytes) -> tuple[bytes, bytes]:
    """(EXIF, XMP) segments of JPEG bytes, empty where there is none."""
    exif_block, xmp_packet = b"", b""
    for marker, segment in _segments(data):
        if marker == 0xE1 and segment.startswith(_EXIF_HEAD):
            exif_block = exif_block or segment
        elif marker == 0xE1 and segment.startswith(_XMP_HEAD):
            xmp_packet = xmp_packet or segment[len(_XMP_HEAD) :]
    return exif_block, xmp_packet


def _segments(data: bytes) -> Iterator[tuple[int, bytes]]:
    at = 2 if data.startswith(b"\xff\xd8") else len(data)
    while at + 4 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker == 0xFF:  # a fill byte
            at += 1
            continue
        if marker in (0xDA, 0xD9):  # the picture begins, or the file ends
            return
        size = int.from_bytes(data[at + 2 : at + 4], "big")
        yield marker, data[at + 4 : at + 2 + size]
        at += 2 + max(size, 2)


def _directory(exif: Image.Exif, tag: int) -> dict[int, Any]:
    try:
        return dict(_items(exif.get_ifd(tag)))
    except Exception:  # as above: a broken sub-directory is a missing one
        return {}


def _items(directory: Any) -> Iterator[tuple[int, Any]]:
    """Tag by tag: Pillow unpacks lazily, and one broken value must not hide the others."""
    for tag in list(directory):
        try:
            yield int(tag), directory[tag]
        except Exception:
            continue


def _bytes(value: Any) -> bytes:
    return value if isinstance(value, bytes) else b""


def _dji_maker_note(note: bytes) -> dict[int, float]:
    """The float entries of a DJI maker note: a little-endian directory without a header."""
    values: dict[int, float] = {}
    if len(note) < 2 or b"DJI" not in note[:64]:
        return values
    for at in range(2, min(2 + 12 * int.from_bytes(note[:2], "little"), len(note) - 11), 12):
        tag, kind, count = struct.unpack_from("<HHI", note, at)
        if kind == _FLOAT_TYPE and count == 1:
            values[tag] = float(struct.unpack_from("<f", note, at + 8)[0])
    return {tag: value for tag, value in values.items() if math.isfinite(value)}
