"""How wide cameras see: the focal length in pixels, from the several half-answers that photos carry."""

from __future__ import annotations

from dataclasses import dataclass

# Width of the active sensor, mm, by EXIF model in lower case; the makers' data sheets.
_SENSOR_MM = {
    **dict.fromkeys(("fc200", "fc300c", "fc300s", "fc300x", "fc300se", "fc300xw", "fc330", "fc350"), 6.17),
    **dict.fromkeys(("fc220", "fc1102", "fc2103", "fc2204", "fc2403", "fc7203", "fc7303"), 6.17),
    **dict.fromkeys(("fc6310", "fc6310s", "fc6310r", "fc6510", "l1d-20c", "fc3411"), 13.2),
    **dict.fromkeys(("fc550", "fc550raw", "fc6520", "l2d-20c", "m3e", "m3m"), 17.3),
    **dict.fromkeys(("zenmusep1", "zenmuse p1"), 35.9),
    "fc6540": 23.5,
    "fc3170": 6.4,
    "canon powershot sx260 hs": 6.17,
    "canon powershot elph 300 hs": 6.17,
    "canon powershot s100": 7.44,
    "canon powershot s110": 7.44,
    "canon ixus 220 hs": 6.17,
    "dsc-wx220": 6.17,
    "dsc-rx1rm2": 35.9,
    "dsc-rx100": 13.2,
    "dsc-qx1": 23.2,
    "ilce-5100": 23.5,
    "ilce-6000": 23.5,
    "ilce-qx1": 23.2,
    "nex-5n": 23.4,
    "nex-7": 23.5,
    "xt701": 6.17,
    "hero4 black": 6.17,
}
_FULL_FRAME_DIAGONAL_MM = 43.2666
_WIDE_SIDES = 1.6  # photos longer than this are cut from a 4:3 sensor
_DIAGONAL_OF_4_3 = 1.25


@dataclass(frozen=True, slots=True)
class LensFacts:
    """What a photo says of its lens; None where it does not.

    `calibrated_px` at a photo `calibrated_long_px` pixels long; `focal_mm`; `focal_35mm`: the 35 mm
    equivalent; `pixels_per_mm` on the sensor for a photo `exif_long_px` pixels long; `zoom`: the digital one.
    """

    model: str = ""
    calibrated_px: float | None = None
    calibrated_long_px: float | None = None
    focal_mm: float | None = None
    focal_35mm: float | None = None
    pixels_per_mm: float | None = None
    exif_long_px: float | None = None
    zoom: float | None = None


def focal_length_px(facts: LensFacts, width: int, height: int) -> float | None:
    """The focal length in pixels of a (width, height) photo, the surest answer first, or None.

    The maker's calibration, then the sensor table, then the 35 mm equivalent, then the focal plane's
    resolution, which is last because programs that shrink photos forget it.
    """
    long_px, short_px = max(width, height), min(width, height)
    zoom = facts.zoom if facts.zoom and 1 <= facts.zoom <= 20 else 1.0
    answers = (
        _calibrated(facts, long_px),
        _by_sensor(facts, long_px, zoom),
        _by_35mm(facts, long_px, short_px),
        _by_focal_plane(facts, long_px, zoom),
    )
    return next((f for f in answers if f is not None and 0.2 <= f / long_px <= 30), None)


def _calibrated(facts: LensFacts, long_px: int) -> float | None:
    if not facts.calibrated_px or not facts.calibrated_long_px or facts.calibrated_long_px < 64:
        return None
    return facts.calibrated_px * long_px / facts.calibrated_long_px


def _by_sensor(facts: LensFacts, long_px: int, zoom: float) -> float | None:
    sensor_mm = _SENSOR_MM.get(facts.model.lower())
    return facts.focal_mm / sensor_mm * long_px * zoom if sensor_mm and facts.focal_mm else None


def _by_35mm(facts: LensFacts, long_px: int, short_px: int) -> float | None:
    if not facts.focal_35mm:
        return None
    # Equivalence is one of diagonals; a 16:9 photo keeps the number of the whole 4:3 sensor it is cut from.
    wide = long_px > _WIDE_SIDES * short_px
    diagonal_px = _DIAGONAL_OF_4_3 * long_px if wide else float((long_px**2 + short_px**2) ** 0.5)
    return facts.focal_35mm / _FULL_FRAME_DIAGONAL_MM * diagonal_px


def _by_focal_plane(facts: LensFacts, long_px: int, zoom: float) -> float | None:
    if not facts.pixels_per_mm or facts.pixels_per_mm <= 0 or not facts.focal_mm:
        return None
    sensor_mm = (facts.exif_long_px or long_px) / facts.pixels_per_mm
    return facts.focal_mm / sensor_mm * long_px * zoom if 1 <= sensor_mm <= 80 else None
