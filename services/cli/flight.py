"""The photos of a folder in the order they were taken."""

from __future__ import annotations

import hashlib
import math
import os
from collections import Counter
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from PIL import Image

from core.errors import OrthostreamError
from services.export_names import NAMES

SUFFIXES = (".jpg", ".jpeg", ".jpe", ".mpo", ".tif", ".tiff")
OTHER_PICTURES = (
    ".png",
    ".dng",
    ".heic",
    ".heif",
    ".webp",
    ".bmp",
    ".gif",
    ".jp2",
    ".arw",
    ".cr2",
    ".nef",
    ".raw",
)
_EXIF_IFD, _DATE_ORIGINAL, _SUBSEC_ORIGINAL, _DATE_TIME = 0x8769, 0x9003, 0x9291, 0x0132


class NoPhotos(OrthostreamError):
    """There are no photos in that folder."""

    code = "no_photos"


@dataclass(frozen=True, slots=True)
class Photo:
    """A file to upload. `name`: what the mission calls it; `frame_id`: of its bytes, see `identify`."""

    path: Path
    name: str
    captured_s: float


def find_photos(folder: Path, out: Path | None = None) -> list[Photo]:
    """All JPEG and TIFF files below `folder`, in capture order. Raises NoPhotos with what to do.

    `out`: where the results of the run before lie; they are no photos.
    """
    if not folder.exists():
        raise NoPhotos(f"There is no folder {folder}. Name the one that holds the drone's photos.")
    if not folder.is_dir():
        raise NoPhotos(f"{folder} is not a folder. Name the folder that holds the drone's photos.")
    paths = sorted(p for p in folder.rglob("*") if _is_photo(p, folder, SUFFIXES) and not _result(p, out))
    if not paths:
        raise NoPhotos(
            f"No photos in {folder}: nothing in it ends in {', '.join(SUFFIXES)}. "
            "Copy the JPEG or TIFF files from the drone's card and name their folder."
        )
    known = Counter(p.name for p in paths)
    photos = [Photo(p, _name(p, folder, known[p.name] > 1), captured_s(p)) for p in paths]
    return sorted(photos, key=lambda p: (p.captured_s, p.name))


def left_out(folder: Path) -> list[Path]:
    """Pictures below `folder` that are of no kind that can be mapped, sorted."""
    return sorted(p for p in folder.rglob("*") if _is_photo(p, folder, OTHER_PICTURES))


def _is_photo(path: Path, folder: Path, suffixes: tuple[str, ...]) -> bool:
    hidden = any(part.startswith(".") for part in path.relative_to(folder).parts)
    return not hidden and path.suffix.lower() in suffixes and path.is_file()


def _result(path: Path, out: Path | None) -> bool:
    return out is not None and path.name in NAMES and path.parent.resolve() == out.resolve()


def _name(path: Path, folder: Path, ambiguous: bool) -> str:
    """The file's name, with its folders' where another has the same; bytes that are no text become �."""
    # Joined by "_": a photo's name holds no folders on the server, whoever sends it.
    name = "_".join(path.relative_to(folder).parts) if ambiguous else path.name
    return os.fsencode(name).decode("utf-8", "replace")


def captured_s(path: Path) -> float:
    """The camera's clock in the EXIF header, +inf without one: only the order of upload depends on it."""
    try:
        with Image.open(path) as image:
            exif = image.getexif()
            taken = exif.get_ifd(_EXIF_IFD)
            text = str(taken.get(_DATE_ORIGINAL) or exif.get(_DATE_TIME))
            part = "".join(c for c in str(taken.get(_SUBSEC_ORIGINAL, "")) if c.isdigit())
        moment = datetime.strptime(text.strip("\x00 "), "%Y:%m:%d %H:%M:%S")
        return moment.timestamp() + float(f"0.{part or 0}")
    except Exception:  # torn files go up too: the service says what is wrong with them
        return math.inf


def identify(data: bytes) -> str:
    """The frame id of a photo's bytes."""
    return hashlib.sha256(data).hexdigest()[:32]
