"""What a drone or ground station knows of a photo and sends along with it, as JSON or as a CSV table.

Every key is optional: `lat`, `lon` (WGS84 degrees), `alt` (metres, any datum), `relative_alt` (metres above
take-off), `sigma_h`, `sigma_v` (metres, standard deviations), `yaw` (degrees, heading of the picture's top
edge, clockwise from true north), `pitch` (degrees, −90 = straight down), `roll` (degrees), `time` (ISO 8601;
without an offset it is UTC; or seconds since 1970), `drone` (a name). Other keys are ignored.
"""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from io import StringIO
from typing import Any

from core.errors import BadTelemetry

Telemetry = dict[str, float | str]

_ALIASES = {
    "latitude": "lat",
    "longitude": "lon",
    "lng": "lon",
    "altitude": "alt",
    "relative_altitude": "relative_alt",
    "heading": "yaw",
    "timestamp": "time",
}
_RANGES = {
    "lat": (-90.0, 90.0),
    "lon": (-180.0, 180.0),
    "alt": (-1000.0, 50_000.0),
    "relative_alt": (-1000.0, 50_000.0),
    "sigma_h": (0.0, 100_000.0),
    "sigma_v": (0.0, 100_000.0),
    "yaw": (-360.0, 360.0),
    "pitch": (-180.0, 180.0),
    "roll": (-180.0, 180.0),
}
_NAME_COLUMNS = ("name", "file", "filename", "image", "photo")


def parse_telemetry(document: str | bytes | Mapping[str, Any]) -> Telemetry:
    """Telemetry as JSON text or an object → its known keys with checked values; `time` in seconds since 1970.

    Applied to its own result it changes nothing. Raises BadTelemetry with the key and what it should hold.
    """
    if isinstance(document, str | bytes):
        document = _object(document)
    known: Telemetry = {}
    for key in sorted(document):
        name = _ALIASES.get(key.strip().lower(), key.strip().lower())
        value = document[key]
        if value is None or value == "" or name in known:
            continue
        if name in _READERS:
            known[name] = _READERS[name](name, value)
    if ("lat" in known) != ("lon" in known):
        raise BadTelemetry("The telemetry holds only one of lat and lon: send both or neither.")
    return known


def parse_table(table: str) -> dict[str, Telemetry]:
    """A CSV with a header row, a column `name` (the photo's file name) and the keys above → by file name.

    Raises BadTelemetry with the line.
    """
    reader = csv.DictReader(StringIO(table.lstrip("\ufeff")), skipinitialspace=True)
    columns = [c for c in reader.fieldnames or () if c and c.strip().lower() in _NAME_COLUMNS]
    if not columns:
        raise BadTelemetry("The telemetry table has no column `name` with the photos' file names.")
    rows: dict[str, Telemetry] = {}
    try:
        for row in reader:
            name = (row.pop(columns[0]) or "").strip()
            if name:
                rows[name] = parse_telemetry({k: v for k, v in row.items() if isinstance(k, str)})
    except (BadTelemetry, csv.Error) as error:
        raise BadTelemetry(f"Line {reader.line_num} of the telemetry table: {error}") from error
    return rows


def _object(document: str | bytes) -> Mapping[str, Any]:
    try:
        parsed = json.loads(document)
    except (ValueError, RecursionError) as error:
        raise BadTelemetry(f"The telemetry is not JSON ({error}).") from error
    if not isinstance(parsed, dict):
        raise BadTelemetry('The telemetry is not a JSON object such as {"lat": 46.8, "lon": -92.0}.')
    return parsed


def _quantity(name: str, value: Any) -> float:
    low, high = _RANGES[name]
    try:
        number = math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not low <= number <= high:
        raise BadTelemetry(f"The telemetry's {name} is {value!r:.40}, not a number from {low:g} to {high:g}.")
    return number


def _instant(name: str, value: Any) -> float:
    try:
        if isinstance(value, str) and not value.strip().replace(".", "", 1).isdigit():
            moment = datetime.fromisoformat(value.strip())
            seconds = (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()
        else:
            seconds = math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError, OverflowError):
        seconds = math.nan
    if not 0 <= seconds < 1e11:
        raise BadTelemetry(
            f"The telemetry's {name} is {value!r:.40}, not a time such as 2024-05-01T12:00:00Z."
        )
    return seconds


def _name(name: str, value: Any) -> str:
    if not isinstance(value, str | int) or isinstance(value, bool) or not str(value).isprintable():
        raise BadTelemetry(f"The telemetry's {name} is {value!r:.40}, not a name.")
    return str(value).strip()[:64]


_READERS: dict[str, Callable[[str, Any], float | str]] = {
    **dict.fromkeys(_RANGES, _quantity),
    "time": _instant,
    "drone": _name,
}
