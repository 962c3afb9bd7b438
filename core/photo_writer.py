"""JPEG photos with the EXIF and XMP that a drone writes."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import UTC, datetime
from math import degrees

import numpy as np
import simplejpeg
from numpy.typing import NDArray
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from core.frame import Attitude, GpsFix

MAKE, MODEL, SENSOR_WIDTH_MM = "DJI", "FC6310S", 13.2
_EXIF_IFD, _GPS_IFD = 0x8769, 0x8825
_XMP_HEAD = b"http://ns.adobe.com/xap/1.0/\x00"


@dataclass(frozen=True, slots=True)
class PhotoTags:
    """What a photo says of itself; None is left out. `f_px`: focal length in pixels. `serial`: the drone's.

    `xmp`: whether there is an XMP packet at all. `flight_yaw_rad`: clockwise from true north.
    """

    captured_s: float
    f_px: float
    serial: str
    gps: GpsFix | None = None
    relative_alt_m: float | None = None
    attitude: Attitude = field(default_factory=Attitude)
    flight_yaw_rad: float | None = None
    xmp: bool = True


def write_photo(rgb: NDArray[np.uint8], tags: PhotoTags, quality: int = 92) -> bytes:
    """The picture (H, W, 3) uint8 RGB as the bytes of a JPEG file with `tags`; same input, same bytes."""
    jpeg: bytes = simplejpeg.encode_jpeg(
        np.ascontiguousarray(rgb), quality=quality, colorspace="RGB", colorsubsampling="420"
    )
    height, width = rgb.shape[:2]
    blocks = _segment(_exif(tags, width, height))
    if tags.xmp:
        blocks += _segment(_XMP_HEAD + _xmp(tags, width, height).encode())
    return jpeg[:2] + blocks + jpeg[2:]


def _segment(payload: bytes) -> bytes:
    return b"\xff\xe1" + (len(payload) + 2).to_bytes(2, "big") + payload


def _exif(tags: PhotoTags, width: int, height: int) -> bytes:
    # What the clock shows, in whole milliseconds: seconds and their fraction go into different tags.
    seconds, millis = divmod(round(tags.captured_s * 1000), 1000)
    stamp = f"{datetime.fromtimestamp(seconds, UTC):%Y:%m:%d %H:%M:%S}"
    exif = Image.Exif()
    exif[0x010F], exif[0x0110], exif[0x0131], exif[0x0132] = MAKE, MODEL, "orthostream simulate", stamp
    exif[0x0112] = 1
    f_mm = tags.f_px / width * SENSOR_WIDTH_MM
    exif.get_ifd(_EXIF_IFD).update(
        {
            0x9003: stamp,
            0x9004: stamp,
            0x9291: f"{millis:03d}",
            0x9011: "+00:00",
            0x920A: IFDRational(round(f_mm * 10_000), 10_000),
            0xA405: round(tags.f_px / float(np.hypot(width, height)) * 43.2666),
            0xA002: width,
            0xA003: height,
            0xA431: tags.serial,
        }
    )
    if tags.gps:
        exif.get_ifd(_GPS_IFD).update(_gps(tags.gps))
    return b"" + bytes(exif.tobytes())


def _gps(fix: GpsFix) -> dict[int, object]:
    tags: dict[int, object] = {
        0: b"\x02\x03\x00\x00",
        1: "N" if fix.lat_deg >= 0 else "S",
        2: _sexagesimal(fix.lat_deg),
        3: "E" if fix.lon_deg >= 0 else "W",
        4: _sexagesimal(fix.lon_deg),
    }
    if fix.alt_m is not None:
        tags |= {5: b"\x01" if fix.alt_m < 0 else b"\x00", 6: IFDRational(round(abs(fix.alt_m) * 1000), 1000)}
    return tags


def _sexagesimal(angle_deg: float) -> tuple[IFDRational, IFDRational, IFDRational]:
    """Degrees, minutes, seconds; the seconds to 10⁻⁶, a thirtieth of a millimetre."""
    minutes, micro = divmod(round(abs(angle_deg) * 3_600_000_000), 60_000_000)
    whole, minutes = divmod(minutes, 60)
    return IFDRational(whole, 1), IFDRational(minutes, 1), IFDRational(micro, 1_000_000)


def _xmp(tags: PhotoTags, width: int, height: int) -> str:
    fields: dict[str, str] = {
        "DroneModel": "FC6310S",
        "DroneSerialNumber": tags.serial,
        "CalibratedFocalLength": f"{tags.f_px:.4f}",
        "CalibratedOpticalCenterX": f"{width / 2:.4f}",
        "CalibratedOpticalCenterY": f"{height / 2:.4f}",
    }
    if tags.gps and tags.gps.alt_m is not None:
        fields["AbsoluteAltitude"] = f"{tags.gps.alt_m:+.2f}"
    if tags.gps:
        fields |= {"GpsLatitude": f"{tags.gps.lat_deg:.9f}", "GpsLongitude": f"{tags.gps.lon_deg:.9f}"}
    if tags.gps and tags.gps.sigma_h_m is not None:
        fields |= {
            "RtkFlag": "50",
            "RtkStdLon": f"{tags.gps.sigma_h_m:.5f}",
            "RtkStdLat": f"{tags.gps.sigma_h_m:.5f}",
        }
        fields["RtkStdHgt"] = f"{tags.gps.sigma_v_m or tags.gps.sigma_h_m:.5f}"
    if tags.relative_alt_m is not None:
        fields["RelativeAltitude"] = f"{tags.relative_alt_m:+.2f}"
    angles = {
        "GimbalYawDegree": tags.attitude.yaw_rad,
        "GimbalPitchDegree": tags.attitude.pitch_rad,
        "GimbalRollDegree": tags.attitude.roll_rad,
        "FlightYawDegree": tags.flight_yaw_rad,
    }
    fields |= {name: f"{degrees(angle):+.2f}" for name, angle in angles.items() if angle is not None}
    body = "".join(f'\n   drone-dji:{name}="{value}"' for name, value in fields.items())
    return (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/">\n <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">\n'
        '  <rdf:Description rdf:about="" xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/"'
        f"{body}/>\n </rdf:RDF>\n</x:xmpmeta>"
    )
