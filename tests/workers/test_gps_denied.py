"""Flights without GPS, and parts of flights: local maps to scale, islands that wait, GPS that comes back."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import simplejpeg

from core.frame import FrameMeta
from core.geometry import Array
from core.metadata import read_metadata
from core.mosaic import Mosaic, build, frame_id_of
from core.photo import probe
from core.photo_writer import PhotoTags, write_photo
from core.scale import KnownScale, Marker
from core.simulation import Flight, FlightParams, plan_flight
from services.catalog import frames, missions, poses
from services.report import report
from workers.simulate import simulate

Photos = list[tuple[str, bytes]]
PARAMS = FlightParams(drones=1, lines=1, per_line=13, width_px=480, height_px=360, seed=8)
BLIND = replace(PARAMS, no_gps=1.0, xmp=False, per_line=8)


def photos_of(params: FlightParams, out: Any) -> Photos:
    simulate(params, out, jobs=2, truth=False)
    return [(p.name, p.read_bytes()) for p in sorted((out / "images").iterdir())]


@pytest.fixture(scope="module")
def blind(tmp_path_factory: pytest.TempPathFactory) -> Photos:
    """A strip of eight photos that say neither where nor how high they were taken."""
    return photos_of(BLIND, tmp_path_factory.mktemp("blind"))


@pytest.fixture(scope="module")
def strip(tmp_path_factory: pytest.TempPathFactory) -> Photos:
    """A strip of thirteen photos with GPS."""
    return photos_of(PARAMS, tmp_path_factory.mktemp("strip"))


def without_gps(photo: tuple[str, bytes]) -> tuple[str, bytes]:
    name, data = photo
    meta: FrameMeta = read_metadata(data, probe(data))
    assert meta.captured_s is not None
    assert meta.f_px is not None
    tags = PhotoTags(meta.captured_s, meta.f_px, meta.drone, None, None, meta.attitude, xmp=False)
    return name, write_photo(simplejpeg.decode_jpeg(data), tags)


def marker_in(flight: Flight, number: int) -> Marker:
    """Two pixels of one of the photos, and how far apart they really are on the ground."""
    shot = flight.shots[number]
    ends = np.array([[150.0, 130.0], [330.0, 230.0]])
    length_m = float(np.linalg.norm(np.diff(flight.ground(shot, ends)[:, :2], axis=0)))
    (u1, v1), (u2, v2) = ends.tolist()
    return Marker(shot.name, (u1, v1), (u2, v2), length_m)


def exported(bench: Any, name: str) -> bytes:
    row = bench.export(name)
    assert row.state == "ready", row.error
    return bytes(bench.modules["app"].store.get(row.object_key))


def finished(bench: Any, photos: Photos) -> None:
    bench.upload(photos)
    bench.drain()
    bench.finalise()
    bench.drain()
    assert bench.state == "final"


def off(route: Array, flight: Flight) -> tuple[float, float]:
    """The shape's error (RMS after a similarity, share of the length), and the scale."""
    true = [s.pose.center[:2] for s in flight.shots[: len(route)]]
    a, b = route @ (1, 1j), np.array(true) @ (1, 1j)
    a, b = a - a.mean(), b - b.mean()
    z = np.vdot(a, b) / np.vdot(a, a).real
    return float(np.sqrt((abs(b - z * a) ** 2).mean()) / abs(np.diff(b)).sum()), float(abs(z))


def heights_of(flight: Flight) -> Array:
    return np.array([s.pose.center[2] - s.pose.ground_h_m for s in flight.shots])


def test_a_marker_in_any_photo_gives_the_scale(blind: Photos) -> None:
    flight = plan_flight(BLIND)
    found = build(blind, 256, scale=KnownScale(None, marker_in(flight, 5)))
    frame = {frame_id_of(data): name for name, data in blind}
    placed = sorted(found.solution.poses.items(), key=lambda item: frame[item[0]])
    shown = np.array([p.center[2] - p.ground_h_m for _, p in placed])
    assert float(np.sqrt(((shown / heights_of(flight) - 1) ** 2).mean())) < 0.03
    lost = KnownScale(None, replace(marker_in(flight, 5), image="elsewhere.jpg"))
    assert build(blind[:2], 256, scale=lost).tiles == build(blind[:2], 256).tiles


def test_a_flight_without_gps_is_a_local_map_to_scale(bench: Any, blind: Photos) -> None:
    flight = plan_flight(BLIND)
    heights = heights_of(flight)
    scale = KnownScale(float(heights[0]))
    with bench.db.write() as tx:
        missions.set_scale(tx, bench.mission_id, scale)
    finished(bench, blind)
    oracle = build(blind, scale=scale)
    assert bench.tiles() == {tuple(k): v for k, v in oracle.tiles.items()}

    rows = list(csv.DictReader(io.StringIO(exported(bench, "route.csv").decode())))
    assert [r["name"] for r in rows] == [s.name for s in flight.shots]
    assert {(r["source"], r["lon"], r["lat"]) for r in rows} == {("vision-only", "", "")}
    assert all(float(r[f"sigma_{axis}"]) >= 0 for r in rows for axis in "enu")
    shape, turn = off(np.array([[float(r["easting"]), float(r["northing"])] for r in rows]), flight)
    assert shape < 0.01
    assert turn == pytest.approx(1.0, abs=0.03)
    shown = np.array([float(r["height_above_ground"]) for r in rows])
    assert float(np.sqrt(((shown / heights - 1) ** 2).mean())) < 0.03

    document = json.loads(exported(bench, "poses.json"))
    assert document["georeferenced"] is False
    assert "Not georeferenced" in document["note"]
    assert "Not georeferenced" in json.loads(exported(bench, "footprints.geojson"))["note"]
    with bench.db.read() as tx:
        told = report(tx, bench.mission_id)
    assert (told["georeferenced"], told["scale"]["used"]) == (False, True)


def first_height_m(bench: Any) -> float:
    with bench.db.read() as tx:
        known = poses.load(tx, bench.mission_id)
    first = known.placed[min(known.placed, key=lambda k: names(bench)[k])].pose
    return float(first.center[2] - first.ground_h_m)


def test_another_scale_opens_a_final_mission_again_and_shows_at_once(bench: Any, blind: Photos) -> None:
    finished(bench, blind[:4])
    small = bench.tiles()
    with bench.db.write() as tx:
        assert missions.set_scale(tx, bench.mission_id, KnownScale(120.0))
        assert not missions.set_scale(tx, bench.mission_id, KnownScale(120.0))
    assert bench.state == "open"
    bench.send("sequence", bench.mission_id)
    bench.drain()
    assert first_height_m(bench) == pytest.approx(120.0, rel=0.03)
    bench.finalise()
    bench.drain()
    assert bench.state == "final"
    assert first_height_m(bench) == pytest.approx(120.0, rel=0.03)
    assert bench.tiles() != small


def names(bench: Any) -> dict[str, str]:
    with bench.db.read() as tx:
        return {f.id: f.name for f in frames.list(tx, bench.mission_id)}


def states(bench: Any) -> list[str]:
    return [state for _, state in sorted(bench.frame_states().items())]


def test_an_island_without_gps_waits_and_moves_into_place_when_it_is_tied(bench: Any, strip: Photos) -> None:
    lost = [without_gps(p) for p in strip[9:]]
    finished(bench, [*strip[:4], *lost])
    oracle: Mosaic = build([*strip[:4], *lost])
    assert states(bench) == ["fused"] * 4 + ["waiting"] * 4
    assert bench.tiles() == {tuple(k): v for k, v in oracle.tiles.items()}
    assert not oracle.rejected
    document = json.loads(exported(bench, "poses.json"))
    assert document["georeferenced"] is True
    assert [f["name"] for f in document["frames"]] == [name for name, _ in strip[:4]]
    assert [(f["name"], f["source"]) for f in document["waiting"]] == [(n, "vision-only") for n, _ in lost]
    (home,) = {f["submap"] for f in document["waiting"]}
    assert [s["submap"] for s in document["submaps"]] == [0, home]
    with bench.db.read() as tx:
        told = report(tx, bench.mission_id)
    assert [(s["frames"], s["submap"], s["georeferenced_by"]) for s in told["submaps"]] == [
        (4, 0, "gps"), (4, home, "none"),
    ]  # fmt: skip
    assert [w["submap"] for w in told["waiting"]] == [home] * 4
    assert told["rejected"] == []

    for photo in strip[4:9]:  # one of them sees both
        bench.upload([photo])
        bench.drain()
    assert states(bench) == ["fused"] * 13
    with bench.db.read() as tx:
        known = poses.load(tx, bench.mission_id)
        assert report(tx, bench.mission_id)["waiting"] == []
    assert {p.pose.source for p in known.placed.values()} == {"visual"}
    assert {p.pose.submap for p in known.placed.values()} == {0}
    bench.finalise()
    bench.drain()
    whole = build([*strip[:9], *lost])
    assert bench.tiles() == {tuple(k): v for k, v in whole.tiles.items()}


def test_a_local_map_moves_to_its_place_when_gps_comes_back(bench: Any, strip: Photos) -> None:
    def georeferenced() -> bool | None:
        with bench.db.read() as tx:
            return poses.georeferenced(tx, bench.mission_id)

    bench.upload([without_gps(photo) for photo in strip[:6]])
    bench.drain()
    assert (georeferenced(), states(bench)) == (False, ["fused"] * 6)
    for photo in strip[6:9]:
        bench.upload([photo])
        bench.drain()
        assert georeferenced()
    assert states(bench) == ["fused"] * 9
    flight = plan_flight(PARAMS)
    with bench.db.read() as tx:
        known = poses.load(tx, bench.mission_id)
    in_order = sorted(known.placed, key=lambda k: names(bench)[k])
    shape, turn = off(np.array([known.placed[k].pose.center[:2] for k in in_order]), flight)
    assert shape < 0.01
    assert turn == pytest.approx(1.0, abs=0.15)  # three fixes of 1 m, 12 m apart
