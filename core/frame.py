"""What is known of one photo before anybody looks at its picture."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from core.geometry import Camera


@dataclass(frozen=True, slots=True)
class GpsFix:
    """Where the drone says it was. WGS84 degrees; `alt_m` in whatever datum the maker chose, or None.

    `sigma_h_m`, `sigma_v_m`: the maker's own standard deviations (RTK), None when it states none.
    """

    lat_deg: float
    lon_deg: float
    alt_m: float | None = None
    sigma_h_m: float | None = None
    sigma_v_m: float | None = None


@dataclass(frozen=True, slots=True)
class Attitude:
    """Where the camera looked, as its gimbal says; each angle None when it is not known.

    `yaw_rad`: heading of the picture's top edge, clockwise from true north. `pitch_rad`: −π/2 = straight
    down, 0 = the horizon. `roll_rad`: clockwise about the viewing axis.
    """

    yaw_rad: float | None = None
    pitch_rad: float | None = None
    roll_rad: float | None = None


@dataclass(frozen=True, slots=True)
class FrameMeta:
    """The metadata of one photo, from EXIF, XMP and telemetry sent along. Absence is None, never a default.

    `width`, `height`: pixels as the sensor wrote them, EXIF orientation ignored. `f_px`: focal length in
    pixels of this width, None when the file does not tell. `captured_s`: seconds since 1970, the camera's
    clock. `relative_alt_m`: metres above take-off. `drone`: who flew it; `body`: the camera, so that frames
    with equal `camera_key` share one set of intrinsics.
    """

    width: int
    height: int
    f_px: float | None = None
    captured_s: float | None = None
    gps: GpsFix | None = None
    relative_alt_m: float | None = None
    attitude: Attitude = Attitude()
    drone: str = "unknown"
    body: str = "unknown"

    @property
    def camera_key(self) -> str:
        """Frames with the same key were taken through the same lens at the same size."""
        focal = "?" if self.f_px is None else f"{self.f_px:.0f}"
        return f"{self.body} {self.width}x{self.height} {focal}px"

    def camera(self) -> Camera:
        """The camera before self-calibration; without a focal length, that of a common drone (84° wide)."""
        f_px = self.f_px or 0.56 * max(self.width, self.height)
        return Camera(self.width, self.height, f_px, (self.width - 1) / 2, (self.height - 1) / 2)

    def to_json(self) -> dict[str, Any]:
        """A JSON object that `from_json` turns back into an equal value."""
        nested = {"gps": self.gps and _fields(self.gps), "attitude": _fields(self.attitude)}
        return _fields(self) | nested

    @classmethod
    def from_json(cls, doc: Mapping[str, Any]) -> FrameMeta:
        """The inverse of `to_json`."""
        gps, attitude = doc["gps"], doc["attitude"]
        rest = {k: v for k, v in doc.items() if k not in ("gps", "attitude")}
        return cls(**rest, gps=GpsFix(**gps) if gps else None, attitude=Attitude(**attitude))


def _fields(part: FrameMeta | GpsFix | Attitude) -> dict[str, Any]:
    return {field.name: getattr(part, field.name) for field in fields(part)}
