"""The EXIF and XMP blocks of a photo, found and unpacked; what they mean is `core.metadata`'s business."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from core.xmp import parse_xmp

_EXIF_HEAD = b"Exif\x00\x00"
_XMP_HEAD = b"http://ns.adobe.com/xap/1.0/\x00"
_EXIF_IFD, _GPS_IFD, _MAKER_NOTE, _TIFF_XMP = 0x8769, 0x8825, 0x927C, 700
_FLOAT_TYPE = 11

_ORDERS = {b"II*\x00": "<", b"II\x00*": "<", b"MM\x00*": ">", b"MM*\x00": ">"}  # two are wrong, yet written
_RAW, _ASCII = "B", "s"
_TEXTS = (_RAW, _ASCII)
# How the kinds of values are written, in the words of `struct`; two letters: a fraction.
_KINDS = dict(enumerate((_RAW, _ASCII, "H", "I", "II", "b", _RAW, "h", "i", "ii", "f", "d", "I"), start=1))
_SIZES = {letter: struct.calcsize(f"={letter}") for letter in "BsHIbhifd"}
_LONGEST_LIST = 64
"""More numbers than these are where a TIFF's strips lie, not what is known of the photo."""


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
    block, xmp_packet = _blocks(data) if data.startswith(b"\xff\xd8") else (data, b"")
    order = _ORDERS.get(block[:4])
    if order is None:
        return Tags(xmp=parse_xmp(xmp_packet) if xmp_packet else {})
    image = _directory(block, order, int.from_bytes(block[4:8], "little" if order == "<" else "big"))
    exif, gps = (_directory(block, order, image.get(tag)) for tag in (_EXIF_IFD, _GPS_IFD))
    xmp_packet = xmp_packet or _bytes(image.get(_TIFF_XMP))
    return Tags(
        image=image,
        exif=exif,
        gps=gps,
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
            exif_block = exif_block or segment[len(_EXIF_HEAD) :]
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


def _directory(block: bytes, order: str, at: Any) -> dict[int, Any]:
    """The directory that begins at byte `at`, as far as it is whole: one broken entry hides no other."""
    if not isinstance(at, int) or not 8 <= at <= len(block) - 2:
        return {}
    (count,) = struct.unpack_from(f"{order}H", block, at)
    entry = struct.Struct(f"{order}HHI")
    found: dict[int, Any] = {}
    for start in range(at + 2, min(at + 2 + 12 * count, len(block) - 11), 12):
        tag, kind, n = entry.unpack_from(block, start)
        letters = _KINDS.get(kind, "")
        size = n * sum(_SIZES[letter] for letter in letters)
        if size > 4:
            (start,) = struct.unpack_from(f"{order}I", block, start + 8)
        else:
            start += 8
        if size and start + size <= len(block) and (letters in _TEXTS or n <= _LONGEST_LIST):
            found[tag] = _value(block[start : start + size], letters, n, order)
    return found


def _value(raw: bytes, letters: str, n: int, order: str) -> Any:
    """Bytes, a text, a number, or a tuple of numbers; a fraction over nothing is NaN."""
    if letters in _TEXTS:
        return raw if letters == _RAW else raw.removesuffix(b"\x00").decode("latin-1")
    parts = struct.unpack(f"{order}{letters * n}", raw)
    if len(letters) == 2:
        parts = tuple(a / b if b else math.nan for a, b in zip(parts[::2], parts[1::2], strict=True))
    return parts[0] if n == 1 else parts


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
