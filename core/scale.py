"""What is known of a mission's scale besides GPS: a first height above ground, or a marker's length."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any

from core.errors import BadScale

LONGEST_M = 100_000.0
SHORTEST_PX = 2.0


@dataclass(frozen=True, slots=True)
class Marker:
    """Something straight of known length on the ground: pixels `start` and `end` (u, v) of the photo `image`.

    `image`: the photo's name; pixels are those of the original photo; `length_m` between the two.
    """

    image: str
    start: tuple[float, float]
    end: tuple[float, float]
    length_m: float

    @property
    def ground_px_per_m(self) -> float:
        """Pixels per metre of ground."""
        return math.dist(self.start, self.end) / self.length_m


@dataclass(frozen=True, slots=True)
class KnownScale:
    """Where GPS cannot tell the scale (Avola 2019, 2.1): at most one of the two.

    `first_height_m`: of the flight's first photo above ground.
    """

    first_height_m: float | None = None
    marker: Marker | None = None

    def to_json(self) -> dict[str, Any] | None:
        """A JSON object that `from_json` turns back into an equal value; None when nothing is known."""
        if self.marker is not None:
            m = self.marker
            marker = {"photo": m.image, "pixels": [[*m.start], [*m.end]], "length_m": m.length_m}
            return {"first_height_m": None, "marker": marker}
        return (
            None if self.first_height_m is None else {"first_height_m": self.first_height_m, "marker": None}
        )

    @classmethod
    def from_json(cls, document: Mapping[str, Any] | None) -> KnownScale:
        """The inverse of `to_json`. Raises BadScale where a number makes no sense, or both are given."""
        height, marker = (document or {}).get("first_height_m"), (document or {}).get("marker")
        if height is not None and marker is not None:
            raise BadScale("Give a first height or a marker, not both: they would contradict each other.")
        if height is not None:
            return cls(first_height_m=_length(height, "The first height"))
        return cls() if marker is None else cls(marker=_marker(marker))


UNKNOWN = KnownScale()


def _marker(document: Mapping[str, Any]) -> Marker:
    start, end = ((float(u), float(v)) for u, v in document["pixels"])
    if not all(map(math.isfinite, (*start, *end))) or math.dist(start, end) < SHORTEST_PX:
        raise BadScale("The marker's two pixels must lie apart.")
    return Marker(str(document["photo"]), start, end, _length(document["length_m"], "The marker's length"))


def _length(value: Any, what: str) -> float:
    if not 0 < float(value) < LONGEST_M:
        raise BadScale(f"{what} is {value} m; it must be above 0.")
    return float(value)


def parse_marker(text: str) -> Marker:
    """A marker written as PHOTO:u1,v1,u2,v2:LENGTH_M. Raises BadScale."""
    try:
        image, pixels, length = text.rsplit(":", 2)
        u1, v1, u2, v2 = (float(p) for p in pixels.split(","))
        document = {"photo": image, "pixels": [[u1, v1], [u2, v2]], "length_m": float(length)}
    except ValueError as error:
        raise BadScale(
            f"{text!r} is no marker. Write PHOTO:u1,v1,u2,v2:LENGTH_M, the pixels of its two ends in that "
            "photo and the metres between them, as DJI_0007.JPG:1033,702,1391,698:2.5."
        ) from error
    return _marker(document)


def named(image: str, names: Sequence[str]) -> str | None:
    """The one of `names` that is meant: itself, or the only one with that file name. None else."""
    if image in names:
        return image
    short = PurePosixPath(image.replace("\\", "/")).name.lower()
    found = [n for n in names if PurePosixPath(n).name.lower() == short]
    return found[0] if len(found) == 1 else None
