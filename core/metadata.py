"""One photo's metadata, gathered from EXIF, the makers' XMP and telemetry sent along.

Missing or wrong values are normal: they become None and the picture itself has to tell.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from datetime import UTC, datetime, timedelta, timezone
from typing import Any, Protocol

from core.exif import Tags, number, read_tags, text
from core.frame import Attitude, FrameMeta, GpsFix
from core.lenses import LensFacts, focal_length_px
from core.telemetry import Telemetry, parse_table, parse_telemetry

__all__ = ["parse_table", "parse_telemetry", "read_metadata"]

# EXIF tag numbers, named as in the standard.
_MAKE, _MODEL, _DATE_TIME = 0x010F, 0x0110, 0x0132
_DATE_ORIGINAL, _DATE_DIGITIZED, _OFFSET, _OFFSET_ORIGINAL = 0x9003, 0x9004, 0x9010, 0x9011
_SUBSEC, _SUBSEC_ORIGINAL = 0x9290, 0x9291
_FOCAL_LENGTH, _FOCAL_35MM, _ZOOM, _BODY_SERIAL = 0x920A, 0xA405, 0xA404, 0xA431
_EXIF_WIDTH, _EXIF_HEIGHT, _PLANE_RES, _PLANE_UNIT = 0xA002, 0xA003, 0xA20E, 0xA210
_MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
_LAT_REF, _LAT, _LON_REF, _LON, _ALT_REF, _ALT = 1, 2, 3, 4, 5, 6
_TRACK, _IMAGE_DIRECTION, _H_ERROR = 15, 17, 31
_GPS_TIME, _GPS_DATE = 7, 29
_DJI_PITCH, _DJI_YAW, _DJI_ROLL = 9, 10, 11  # of the camera, in DJI's maker note

_YAW_XMP = (
    "drone-dji:GimbalYawDegree",
    "drone-parrot:CameraYawDegree",
    "drone-skydio:CameraOrientationNED/drone-skydio:Yaw",
    "Camera:Yaw",
    "drone-dji:FlightYawDegree",
    "drone-parrot:DroneYawDegree",
)
_PITCH_XMP = (
    "drone-dji:GimbalPitchDegree",
    "drone-parrot:CameraPitchDegree",
    "drone-skydio:CameraOrientationNED/drone-skydio:Pitch",
)
_ROLL_XMP = (
    "drone-dji:GimbalRollDegree",
    "drone-parrot:CameraRollDegree",
    "drone-skydio:CameraOrientationNED/drone-skydio:Roll",
    "Camera:Roll",
)
_RELATIVE_ALT_XMP = (
    "drone-dji:RelativeAltitude",
    "drone-skydio:RelativeAltitude",
    "Camera:AboveGroundAltitude",
)
_ABSOLUTE_ALT_XMP = ("drone-dji:AbsoluteAltitude", "drone-skydio:AbsoluteAltitude")
_LAT_XMP = ("drone-dji:GpsLatitude", "drone-dji:Latitude", "drone-skydio:Latitude")
_LON_XMP = (
    "drone-dji:GpsLongitude",
    "drone-dji:GpsLongtitude",
    "drone-dji:Longitude",
    "drone-skydio:Longitude",
)
_SERIAL_XMP = ("drone-dji:DroneSerialNumber", "drone-parrot:SerialNumber", "drone-skydio:SerialNumber")
_CAMERA_SERIAL_XMP = ("drone-dji:CameraSerialNumber", "Camera:SerialNumber", "aux:SerialNumber")

# Clocks that lost their battery start at these years' first day; no drone took photos before.
_FIRST_YEAR, _LAST_YEAR = 2005, 2100


class Size(Protocol):
    """Whatever knows how many pixels a photo has, as a `PhotoHeader` does."""

    @property
    def width(self) -> int:
        """As the sensor wrote them."""

    @property
    def height(self) -> int:
        """As the sensor wrote them."""


def read_metadata(data: bytes, header: Size, telemetry: Mapping[str, Any] | None = None) -> FrameMeta:
    """The metadata of a photo's bytes; telemetry stands above XMP, XMP above EXIF. Garbage reads as None.

    Raises BadTelemetry only, for what `parse_telemetry` would have refused.
    """
    tags = read_tags(data)
    sent = parse_telemetry(telemetry) if telemetry else {}
    make, model = text(tags.image.get(_MAKE)), text(tags.image.get(_MODEL))
    body = _body(tags, make, model)
    return FrameMeta(
        width=header.width,
        height=header.height,
        f_px=focal_length_px(_lens_facts(tags, model), header.width, header.height),
        captured_s=_captured_s(tags, sent),
        gps=_gps(tags, sent),
        relative_alt_m=_first(_sent(sent, "relative_alt"), _altitude(_xmp(tags, _RELATIVE_ALT_XMP))),
        attitude=_attitude(tags, sent),
        drone=str(sent.get("drone") or _named(tags, _SERIAL_XMP) or body),
        body=body,
    )


def _first(*values: float | None) -> float | None:
    return next((v for v in values if v is not None), None)


def _sent(sent: Telemetry, key: str) -> float | None:
    value = sent.get(key)
    return value if isinstance(value, float) else None


def _xmp(tags: Tags, names: tuple[str, ...]) -> float | None:
    return _first(*(number(tags.xmp.get(name)) for name in names))


def _named(tags: Tags, names: tuple[str, ...]) -> str:
    return next((t for t in (text(tags.xmp.get(name)) for name in names) if t), "")


def _body(tags: Tags, make: str, model: str) -> str:
    """Maker, model and serial number: two drones of one model are two cameras."""
    name = model if make and model.lower().startswith(make.lower()) else f"{make} {model}".strip()
    serial = text(tags.exif.get(_BODY_SERIAL)) or _named(tags, _CAMERA_SERIAL_XMP + _SERIAL_XMP)
    return f"{name} #{serial}".strip() if serial else name or "unknown"


def _lens_facts(tags: Tags, model: str) -> LensFacts:
    unit_mm = _MM_PER_UNIT.get(int(number(tags.exif.get(_PLANE_UNIT)) or 2), 25.4)
    per_unit = number(tags.exif.get(_PLANE_RES))
    center_x = number(tags.xmp.get("drone-dji:CalibratedOpticalCenterX"))
    sides = [number(tags.exif.get(tag)) or 0.0 for tag in (_EXIF_WIDTH, _EXIF_HEIGHT)]
    return LensFacts(
        model=model,
        calibrated_px=number(tags.xmp.get("drone-dji:CalibratedFocalLength")),
        calibrated_long_px=2 * center_x if center_x else None,
        focal_mm=number(tags.exif.get(_FOCAL_LENGTH)),
        focal_35mm=number(tags.exif.get(_FOCAL_35MM)),
        pixels_per_mm=per_unit / unit_mm if per_unit else None,
        exif_long_px=max(sides) or None,
        zoom=number(tags.exif.get(_ZOOM)),
    )


def _gps(tags: Tags, sent: Telemetry) -> GpsFix | None:
    lat, lon = _sent(sent, "lat"), _sent(sent, "lon")
    if lat is None or lon is None:
        lat = _degrees(tags.gps.get(_LAT), tags.gps.get(_LAT_REF), "S")
        lon = _degrees(tags.gps.get(_LON), tags.gps.get(_LON_REF), "W")
    if not _on_earth(lat, lon):
        lat, lon = _xmp(tags, _LAT_XMP), _xmp(tags, _LON_XMP)
    if lat is None or lon is None or not _on_earth(lat, lon):
        return None
    return GpsFix(lat, lon, _absolute_alt_m(tags, sent), *_sigmas_m(tags, sent))


def _on_earth(lat: float | None, lon: float | None) -> bool:
    """0°, 0° is what receivers without a fix write."""
    if lat is None or lon is None or (abs(lat) < 1e-6 and abs(lon) < 1e-6):
        return False
    return abs(lat) <= 90 and abs(lon) <= 180


def _degrees(value: Any, ref: Any, negative: str) -> float | None:
    """Degrees, minutes, seconds (or any prefix of them) → signed degrees."""
    parts = [number(part) for part in (value if isinstance(value, tuple) else (value,))[:3]]
    if not parts or parts[0] is None:
        return None
    degrees = math.fsum((part or 0.0) / 60.0**k for k, part in enumerate(parts))
    return -degrees if text(ref).upper().startswith(negative) else degrees


def _absolute_alt_m(tags: Tags, sent: Telemetry) -> float | None:
    below = tags.gps.get(_ALT_REF) in (1, b"\x01", "1")
    exif = number(tags.gps.get(_ALT))
    signed = None if exif is None else -exif if below else exif
    return _first(_sent(sent, "alt"), _altitude(_xmp(tags, _ABSOLUTE_ALT_XMP)), _altitude(signed))


def _altitude(value_m: float | None) -> float | None:
    return value_m if value_m is not None and -1000 <= value_m <= 50_000 else None


def _sigmas_m(tags: Tags, sent: Telemetry) -> tuple[float | None, float | None]:
    """The maker's standard deviations (horizontal, vertical), None where the receiver states none."""
    rtk = [number(tags.xmp.get(f"drone-dji:RtkStd{axis}")) for axis in ("Lon", "Lat", "Hgt")]
    if number(tags.xmp.get("drone-dji:RtkFlag")) == 0:  # no positioning: the deviations are leftovers
        rtk = [None, None, None]
    east_north = [v for v in rtk[:2] if v is not None]
    horizontal = _first(
        _sent(sent, "sigma_h"),
        max(east_north, default=None),
        number(tags.xmp.get("Camera:GPSXYAccuracy")),
        number(tags.gps.get(_H_ERROR)),
    )
    vertical = _first(_sent(sent, "sigma_v"), rtk[2], number(tags.xmp.get("Camera:GPSZAccuracy")))
    return _sigma(horizontal), _sigma(vertical)


def _sigma(value_m: float | None) -> float | None:
    return value_m if value_m is not None and 0 < value_m < 10_000 else None


def _attitude(tags: Tags, sent: Telemetry) -> Attitude:
    # The track over ground comes last: it is off by the wind, but better than nothing.
    yaw = _first(
        _sent(sent, "yaw"),
        _xmp(tags, _YAW_XMP),
        tags.dji.get(_DJI_YAW),
        number(tags.gps.get(_IMAGE_DIRECTION)),
        number(tags.gps.get(_TRACK)),
    )
    pitch = _first(
        _sent(sent, "pitch"), _xmp(tags, _PITCH_XMP), tags.dji.get(_DJI_PITCH), _camera_pitch(tags)
    )
    roll = _first(_sent(sent, "roll"), _xmp(tags, _ROLL_XMP), tags.dji.get(_DJI_ROLL))
    return Attitude(*(_radians(angle) for angle in (yaw, pitch, roll)))


def _camera_pitch(tags: Tags) -> float | None:
    """`Camera:Pitch` counts from straight down by its inventor's rule, from the horizon by some makers'."""
    pitch = number(tags.xmp.get("Camera:Pitch"))
    return pitch - 90 if pitch is not None and abs(pitch) < 45 else pitch


def _radians(degrees: float | None) -> float | None:
    """Wrapped to [−π, π)."""
    if degrees is None or abs(degrees) > 720:
        return None
    return math.radians((degrees + 180) % 360 - 180)


def _captured_s(tags: Tags, sent: Telemetry) -> float | None:
    """The camera's clock, UTC where it states an offset and read as if it were where not; then the GPS's."""
    sources = (
        (tags.exif.get(_DATE_ORIGINAL), tags.exif.get(_SUBSEC_ORIGINAL), tags.exif.get(_OFFSET_ORIGINAL)),
        (tags.exif.get(_DATE_DIGITIZED), tags.exif.get(_SUBSEC_ORIGINAL), tags.exif.get(_OFFSET_ORIGINAL)),
        (tags.image.get(_DATE_TIME), tags.exif.get(_SUBSEC), tags.exif.get(_OFFSET)),
    )
    return _first(_sent(sent, "time"), *(_clock_s(*source) for source in sources), _gps_clock_s(tags))


def _clock_s(stamp: Any, subsec: Any, offset: Any) -> float | None:
    match = re.fullmatch(
        r"(\d{4})[:\-/](\d\d)[:\-/](\d\d)[ T](\d\d):(\d\d):(\d\d)(\.\d{1,9})?.*", text(stamp)
    )
    if not match:
        return None
    zone = re.fullmatch(r"([+-])(\d\d):?(\d\d)", text(offset))
    minutes = (int(zone[2]) * 60 + int(zone[3])) * (-1 if zone[1] == "-" else 1) if zone else 0
    digits = text(subsec)
    fraction = match[7] or (f".{digits}" if digits.isascii() and digits.isdigit() else "0")
    year, month, day, hour, minute, second = (int(part) for part in match.groups()[:6])
    try:
        clock = timezone(timedelta(minutes=minutes))
        moment = datetime(year, month, day, hour, minute, second, tzinfo=clock)
    except ValueError:  # a 13th month, a 25th hour
        return None
    return moment.timestamp() + float(fraction) if _FIRST_YEAR <= moment.year < _LAST_YEAR else None


def _gps_clock_s(tags: Tags) -> float | None:
    clock = tags.gps.get(_GPS_TIME)
    parts = [number(part) for part in clock] if isinstance(clock, tuple) and len(clock) == 3 else []
    match = re.fullmatch(r"(\d{4})[:\-](\d\d)[:\-](\d\d)", text(tags.gps.get(_GPS_DATE)))
    if not match or not parts or None in parts:
        return None
    try:
        day = datetime(int(match[1]), int(match[2]), int(match[3]), tzinfo=UTC)
    except ValueError:
        return None
    seconds = sum((part or 0.0) * unit for part, unit in zip(parts, (3600, 60, 1), strict=True))
    return (
        day.timestamp() + seconds if _FIRST_YEAR <= day.year < _LAST_YEAR and 0 <= seconds < 86_401 else None
    )
