"""Every maker's dialect reads as one; whatever is missing or wrong reads as None; nothing makes it raise."""

from __future__ import annotations

import io
import json
import math
import struct
from collections.abc import Mapping
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from core.errors import BadTelemetry
from core.frame import FrameMeta
from core.metadata import parse_table, parse_telemetry, read_metadata
from core.photo import probe
from core.xmp import parse_xmp

FLIGHTS = Path(__file__).resolve().parents[2].parent / "shared" / "data"
NOON_S = datetime(2024, 5, 1, 12, tzinfo=UTC).timestamp()

DJI = {
    "drone-dji:GimbalYawDegree": "+45.00",
    "drone-dji:GimbalPitchDegree": "-89.90",
    "drone-dji:GimbalRollDegree": "+0.50",
    "drone-dji:FlightYawDegree": "+10.00",
    "drone-dji:RelativeAltitude": "+39.80",
    "drone-dji:AbsoluteAltitude": "+198.31",
    "drone-dji:RtkFlag": "50",
    "drone-dji:RtkStdLon": "0.011",
    "drone-dji:RtkStdLat": "0.014",
    "drone-dji:RtkStdHgt": "0.025",
    "drone-dji:DroneSerialNumber": "1581F5BKD",
}


def packet(properties: Mapping[str, str], attributes: bool = True) -> bytes:
    if attributes:
        inner = " ".join(f'{k}="{v}"' for k, v in properties.items())
        body = f"<rdf:Description {inner}/>"
    else:
        inner = "".join(f"<{k}>{v}</{k}>" for k, v in properties.items())
        body = f"<rdf:Description>{inner}</rdf:Description>"
    head = '<?xpacket begin="" id="W5M0"?><x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF>'
    return f'{head}{body}</rdf:RDF></x:xmpmeta>\n  <?xpacket end="w"?>'.encode()


def photo(
    image: Mapping[int, Any] | None = None,
    exif: Mapping[int, Any] | None = None,
    gps: Mapping[int, Any] | None = None,
    xmp: bytes | None = None,
    size: tuple[int, int] = (400, 300),
    kind: str = "JPEG",
) -> bytes:
    tags = Image.Exif()
    tags.update(dict(image or {}))
    for directory, values in ((0x8769, exif), (0x8825, gps)):
        if values:
            tags.get_ifd(directory).update(dict(values))
            tags[directory] = 0  # Pillow writes a TIFF's directories only where their place is taken
    out = io.BytesIO()
    extra: dict[str, Any] = {"xmp": xmp} if xmp is not None and kind == "JPEG" else {}
    if xmp is not None and kind == "TIFF":
        tags[700] = xmp
    Image.new("RGB", size, (90, 120, 60)).save(out, kind, exif=tags, **extra)
    return out.getvalue()


def read(data: bytes, telemetry: Mapping[str, Any] | None = None) -> FrameMeta:
    return read_metadata(data, probe(data), telemetry)


def gps_tags(lat: float, lon: float, alt: float | None = 120.5) -> dict[int, Any]:
    def dms(value: float) -> tuple[IFDRational, IFDRational, IFDRational]:
        minutes = abs(value) % 1 * 60
        whole = (int(abs(value)), int(minutes), round(minutes % 1 * 60 * 100_000))
        return IFDRational(whole[0], 1), IFDRational(whole[1], 1), IFDRational(whole[2], 100_000)

    tags: dict[int, Any] = {
        1: "N" if lat >= 0 else "S",
        2: dms(lat),
        3: "E" if lon >= 0 else "W",
        4: dms(lon),
    }
    if alt is not None:
        tags |= {5: b"\x00" if alt >= 0 else b"\x01", 6: IFDRational(round(abs(alt) * 1000), 1000)}
    return tags


def finite(meta: FrameMeta) -> bool:
    """Every number in it, however deep, is finite."""

    def numbers(value: Any) -> list[float]:
        if isinstance(value, dict):
            return [n for v in value.values() for n in numbers(v)]
        return [value] if isinstance(value, int | float) else []

    return all(math.isfinite(n) for n in numbers(meta.to_json()))


@settings(deadline=None)
@given(
    st.floats(-89.9, 89.9).filter(lambda v: abs(v) > 1e-3),
    st.floats(-179.9, 179.9),
    st.one_of(st.none(), st.floats(-400, 8000)),
    st.sampled_from(["JPEG", "TIFF"]),
)
def test_positions_survive_the_way_through_exif(lat: float, lon: float, alt: float | None, kind: str) -> None:
    gps = read(photo(gps=gps_tags(lat, lon, alt), kind=kind)).gps
    assert gps is not None
    assert gps.lat_deg == pytest.approx(lat, abs=1e-8)
    assert gps.lon_deg == pytest.approx(lon, abs=1e-8)
    assert gps.alt_m == (None if alt is None else pytest.approx(alt, abs=1e-3))


@pytest.mark.parametrize(
    "tags",
    [
        {},
        gps_tags(0, 0),
        {1: "N", 2: (91.0, 0.0, 0.0), 3: "E", 4: (9.0, 0.0, 0.0)},
        {1: "N", 2: (47.0, 0.0, 0.0), 3: "E", 4: (181.0, 0.0, 0.0)},
        {1: "N", 2: (IFDRational(1, 0), 0.0, 0.0), 3: "E", 4: (9.0, 0.0, 0.0)},
        {1: "N", 2: (47.0, 0.0, 0.0)},
    ],
)
def test_positions_that_cannot_be_are_none(tags: dict[int, Any]) -> None:
    assert read(photo(gps=tags)).gps is None


@pytest.mark.parametrize(
    ("stamp", "subsec", "offset", "seconds"),
    [
        ("2024:05:01 12:00:00", "25", None, NOON_S + 0.25),
        ("2024:05:01 12:00:00", None, "+02:00", NOON_S - 7200),
        ("2024:05:01 12:00:00", None, "-05:30", NOON_S + 19_800),
        ("2024-05-01T12:00:00", None, None, NOON_S),
        ("1970:01:01 00:00:00", None, None, None),
        ("1980:01:01 00:00:00", None, None, None),
        ("2000:01:01 00:00:10", None, None, None),
        ("0000:00:00 00:00:00", None, None, None),
        ("2024:13:41 12:00:00", None, None, None),
        ("    :  :     :  :  ", None, None, None),
        ("2024:05:01 12:00:00", "no", "ever", NOON_S),
    ],
)
def test_time(stamp: str, subsec: str | None, offset: str | None, seconds: float | None) -> None:
    tags = {0x9003: stamp, 0x9291: subsec, 0x9011: offset}
    assert read(photo(exif={k: v for k, v in tags.items() if v})).captured_s == seconds


def test_the_clock_of_the_gps_helps_out() -> None:
    tags = gps_tags(47, 9) | {7: (12.0, 0.0, 1.5), 29: "2024:05:01"}
    assert read(photo(exif={0x9003: "1970:01:01 00:00:00"}, gps=tags)).captured_s == NOON_S + 1.5


@pytest.mark.parametrize("attributes", [True, False])
@pytest.mark.parametrize("kind", ["JPEG", "TIFF"])
def test_dji(attributes: bool, kind: str) -> None:
    meta = read(photo(gps=gps_tags(46, -92, 7.0), xmp=packet(DJI, attributes), kind=kind))
    assert meta.attitude.yaw_rad == pytest.approx(math.radians(45))
    assert meta.attitude.pitch_rad == pytest.approx(math.radians(-89.9))
    assert meta.attitude.roll_rad == pytest.approx(math.radians(0.5))
    assert meta.relative_alt_m == 39.8
    assert meta.drone == "1581F5BKD"
    assert meta.gps is not None
    assert (meta.gps.alt_m, meta.gps.sigma_h_m, meta.gps.sigma_v_m) == (198.31, 0.014, 0.025)


def test_without_a_gimbal_the_aircrafts_heading_counts_and_without_rtk_no_sigma() -> None:
    meta = read(photo(gps=gps_tags(46, -92), xmp=packet({**DJI, "drone-dji:GimbalYawDegree": "n/a",
                                                         "drone-dji:RtkFlag": "0"})))  # fmt: skip
    assert meta.attitude.yaw_rad == pytest.approx(math.radians(10))
    assert meta.gps is not None
    assert meta.gps.sigma_h_m is None


@pytest.mark.parametrize(
    ("properties", "pitch_deg"),
    [
        ({"Camera:Yaw": "-170.5", "Camera:Pitch": "3", "Camera:Roll": "1"}, -87),
        ({"Camera:Yaw": "189.5", "Camera:Pitch": "-87", "Camera:Roll": "1"}, -87),
        (
            {
                "drone-parrot:CameraYawDegree": "189.5",
                "drone-parrot:CameraPitchDegree": "-87",
                "drone-parrot:CameraRollDegree": "1",
            },
            -87,
        ),
    ],
)
def test_other_makers(properties: dict[str, str], pitch_deg: float) -> None:
    attitude = read(photo(xmp=packet(properties))).attitude
    assert attitude.yaw_rad == pytest.approx(math.radians(-170.5))
    assert attitude.pitch_rad == pytest.approx(math.radians(pitch_deg))
    assert attitude.roll_rad == pytest.approx(math.radians(1))


def test_skydios_nested_angles() -> None:
    angles = "".join(
        f"<drone-skydio:{k}>{v}</drone-skydio:{k}>" for k, v in (("Yaw", 30), ("Pitch", -88), ("Roll", 2))
    )
    name = "drone-skydio:CameraOrientationNED"
    nested = f'<{name} rdf:parseType="Resource">{angles}</{name}>'
    xmp = f"<x:xmpmeta><rdf:RDF><rdf:Description>{nested}</rdf:Description></rdf:RDF></x:xmpmeta>".encode()
    attitude = read(photo(xmp=xmp)).attitude
    assert attitude.yaw_rad == pytest.approx(math.radians(30))
    assert attitude.pitch_rad == pytest.approx(math.radians(-88))


@pytest.mark.parametrize(
    ("model", "exif", "size", "f_px"),
    [
        ("FC300S", {0x920A: 3.61, 0xA405: 20}, (2000, 1125), 3.61 / 6.17 * 2000),  # 16:9 cut from 4:3
        ("FC6310", {0x920A: 8.8, 0xA405: 24}, (547, 365), 8.8 / 13.2 * 547),
        ("unknown 4:3", {0xA405: 24}, (400, 300), 24 / 43.2666 * 500),
        ("unknown 16:9", {0xA405: 24}, (1600, 900), 24 / 43.2666 * 2000),
        ("unknown portrait", {0xA405: 24}, (300, 400), 24 / 43.2666 * 500),
        # 4000 px on 6.1 mm, shrunk to 400 px by a program that left the focal plane's resolution alone.
        ("by plane", {0x920A: 4.5, 0xA20E: 4000 / 6.1 * 25.4, 0xA002: 4000}, (400, 300), 295.08),
        ("by plane in cm", {0x920A: 4.5, 0xA20E: 400 / 6.1 * 10, 0xA210: 3}, (400, 300), 295.08),
        ("nothing", {}, (400, 300), None),
        ("nonsense", {0x920A: 0.0, 0xA405: 60_000}, (400, 300), None),
    ],
)  # fmt: skip
def test_focal_length(model: str, exif: dict[int, Any], size: tuple[int, int], f_px: float | None) -> None:
    found = read(photo(image={0x0110: model}, exif=exif, size=size)).f_px
    assert found == (None if f_px is None else pytest.approx(f_px, rel=1e-3))


def test_djis_own_calibration_is_scaled_to_the_photo() -> None:
    calibration = {
        "drone-dji:CalibratedFocalLength": "3666.6",
        "drone-dji:CalibratedOpticalCenterX": "2736.0",
    }
    assert read(photo(xmp=packet(calibration), size=(684, 456))).f_px == pytest.approx(3666.6 / 8)


def test_two_drones_of_one_model_are_two_cameras() -> None:
    image = {0x010F: "DJI\x00\x00", 0x0110: "FC6310"}
    one, other = (read(photo(image=image, exif={0xA431: serial})) for serial in ("A1", "B2"))
    assert one.body == "DJI FC6310 #A1"
    assert one.camera_key != other.camera_key
    assert read(photo(image={0x010F: "Canon", 0x0110: "Canon EOS"})).body == "Canon EOS"
    assert read(photo()).body == "unknown"


def test_telemetry_stands_above_what_the_photo_says() -> None:
    sent = {
        "lat": -33.5,
        "lon": 151,
        "relative_alt": 55,
        "yaw": 350,
        "time": "2024-05-01T14:00:00+02:00",
        "drone": "c3",
    }
    meta = read(photo(gps=gps_tags(46, -92, 7.0), xmp=packet(DJI)), sent)
    assert meta.gps is not None
    assert (meta.gps.lat_deg, meta.gps.lon_deg) == (-33.5, 151)
    assert (meta.relative_alt_m, meta.captured_s, meta.drone) == (55, NOON_S, "c3")
    assert meta.attitude.yaw_rad == pytest.approx(math.radians(-10))
    assert meta.attitude.pitch_rad == pytest.approx(math.radians(-89.9))


def test_telemetry_is_canonical_after_one_reading() -> None:
    sent = (
        '{"Latitude": "47.5", "longitude": 9, "heading": 20, "battery": {"v": 11}, "time": "2024-05-01T12Z"}'
    )
    once = parse_telemetry(sent)
    assert once == {"lat": 47.5, "lon": 9.0, "yaw": 20.0, "time": NOON_S}
    assert parse_telemetry(once) == once
    assert parse_telemetry(json.dumps(once)) == once


@pytest.mark.parametrize(
    ("sent", "word"),
    [
        ("{", "JSON"),
        ("[1]", "object"),
        ('{"lat": 47}', "lon"),
        ('{"lat": 97, "lon": 9}', "lat"),
        ('{"lat": NaN, "lon": 9}', "lat"),
        ('{"lat": true, "lon": 9}', "lat"),
        ('{"yaw": "north"}', "yaw"),
        ('{"time": "yesterday"}', "time"),
        ('{"drone": {"a": 1}}', "drone"),
        ("[" * 100_000, "JSON"),
    ],
)
def test_bad_telemetry_says_what_is_wrong(sent: str, word: str) -> None:
    with pytest.raises(BadTelemetry, match=word):
        parse_telemetry(sent)


def test_a_table_of_telemetry() -> None:
    rows = parse_table("\ufeffname, lat, lon, alt\nDJI_1.JPG,47.1,9.2,\nDJI_2.JPG,47.2,9.3,410\n")
    assert rows == {
        "DJI_1.JPG": {"lat": 47.1, "lon": 9.2},
        "DJI_2.JPG": {"lat": 47.2, "lon": 9.3, "alt": 410.0},
    }
    with pytest.raises(BadTelemetry, match="name"):
        parse_table("lat,lon\n1,2\n")
    with pytest.raises(BadTelemetry, match="Line 2"):
        parse_table("name,lat,lon\na.jpg,x,2\n")


@settings(deadline=None)
@given(st.recursive(
    st.none() | st.booleans() | st.floats() | st.text(max_size=20) | st.integers(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(
        st.sampled_from(["lat", "lon", "alt", "yaw", "time", "drone", "x"]), inner, max_size=7),
    max_leaves=12,
))  # fmt: skip
def test_any_telemetry_is_read_or_refused(sent: Any) -> None:
    try:
        known = parse_telemetry(json.dumps(sent))
    except BadTelemetry:
        return
    assert parse_telemetry(known) == known
    assert finite(read(photo(), known))


def test_an_xmp_packet_cannot_declare_entities() -> None:
    bomb = b'<!DOCTYPE x [<!ENTITY a "1"><!ENTITY b "&a;&a;">]><x:xmpmeta drone-dji:RelativeAltitude="&b;"/>'
    assert parse_xmp(bomb) == {}


def test_a_broken_packet_gives_what_stands_before_the_break() -> None:
    broken = packet({"drone-dji:RelativeAltitude": "+39.80"}, attributes=False).replace(
        b"</rdf:RDF>", b"<&<<"
    )
    assert read(photo(xmp=broken)).relative_alt_m == 39.8


@settings(deadline=None)
@given(st.binary(max_size=600), st.binary(max_size=600))
@example(b"Exif\x00\x00II*\x00\x08\x00\x00\x00\xff\xff", b"<x:xmpmeta")
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_random_exif_and_xmp_blocks_read_as_something_finite(exif: bytes, xmp: bytes) -> None:
    plain = photo()
    blocks = b"".join(
        b"\xff\xe1" + (len(block) + 2).to_bytes(2, "big") + block
        for block in (
            b"Exif\x00\x00II*\x00\x08\x00\x00\x00" + exif,
            b"http://ns.adobe.com/xap/1.0/\x00" + xmp,
        )
    )
    data = plain[:2] + blocks + plain[2:]
    meta = read_metadata(data, probe(plain), None)
    assert (meta.width, meta.height) == (400, 300)
    assert finite(meta)


FULL = photo(
    image={0x010F: "DJI", 0x0110: "FC300S", 0x0132: "2024:05:01 12:00:00"},
    exif={0x9003: "2024:05:01 12:00:00", 0x9291: "5", 0x920A: 3.61, 0xA405: 20, 0xA431: "X", 0xA20E: 6557.4},
    gps=gps_tags(46.8, -92) | {7: (12.0, 0.0, 1.5), 29: "2024:05:01", 15: 70.0, 17: 71.0, 31: 2.0},
    xmp=packet(DJI),
)


@pytest.mark.parametrize(("tag", "lost"), [(0x010F, "DJI"), (0x0110, "FC300S")])
def test_one_broken_entry_hides_no_other(tag: int, lost: str) -> None:
    (found,) = (at for order in "<>" if (at := FULL.find(struct.pack(f"{order}HH", tag, 2))) > 0)
    broken = bytearray(FULL)
    broken[found + 2 : found + 4] = b"\xee\xee"  # a kind of value that nobody knows
    before, after = read(FULL), read(bytes(broken))
    assert lost in before.body
    assert lost not in after.body
    assert replace(after, body=before.body, f_px=before.f_px) == before


@settings(deadline=None, max_examples=400)
@given(
    st.lists(st.tuples(st.integers(2, FULL.index(b"\xff\xdb")), st.integers(0, 255)), max_size=30),
    st.integers(0, 40),
)
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_damaged_header_reads_as_something_finite(changes: list[tuple[int, int]], cut: int) -> None:
    data = bytearray(FULL)
    for at, value in changes:
        data[at] = value
    if cut < 20:
        del data[len(data) * cut // 20 :]
    assert finite(read_metadata(bytes(data), probe(FULL), None))


REAL = {
    "brighton_beach": (18, 0.5835, True, True),
    "caliterra": (75, 0.7293, False, False),
    "seneca": (167, 0.6969, False, True),
    "sheffield_cross": (78, 0.5851, False, True),
}
PRESENT = [name for name in REAL if (FLIGHTS / name / "images").is_dir()]

if PRESENT:

    @pytest.mark.parametrize("flight", PRESENT)
    def test_real_flights(flight: str) -> None:
        count, focal, relative_alt, yaw = REAL[flight]
        metas = [read(path.read_bytes()) for path in sorted((FLIGHTS / flight / "images").iterdir())]
        assert len(metas) == count
        assert len({meta.camera_key for meta in metas}) == 1
        for meta in metas:
            assert meta.f_px == pytest.approx(focal * meta.width, rel=1e-3)
            assert meta.captured_s is not None
            assert meta.gps is not None
            assert meta.gps.alt_m is not None
            assert (meta.relative_alt_m is not None) == relative_alt
            assert (meta.attitude.yaw_rad is not None) == yaw
            assert FrameMeta.from_json(json.loads(json.dumps(meta.to_json()))) == meta

    @settings(max_examples=150, deadline=None)
    @given(
        st.sampled_from(PRESENT), st.lists(st.tuples(st.integers(2, 7000), st.integers(0, 255)), max_size=200)
    )
    @pytest.mark.filterwarnings("ignore::UserWarning")
    def test_damaged_real_headers_read_as_something_finite(
        flight: str, changes: list[tuple[int, int]]
    ) -> None:
        data = bytearray(min((FLIGHTS / flight / "images").iterdir()).read_bytes())
        header = probe(bytes(data))
        for at, value in changes:
            data[at] = value
        assert finite(read_metadata(bytes(data), header, None))
