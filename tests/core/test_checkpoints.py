"""Surveyed points: found in the mosaic where it shows them, and the map laid onto those that are chosen."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from pyproj import Transformer
from rasterio.windows import Window
from scipy.spatial.transform import Rotation

from core.alignment import marks_of
from core.checkpoints import (
    Checkpoints,
    by_name,
    checkpoint_errors,
    checkpoints_document,
    observations,
    parse_gcp_list,
)
from core.cog import flight_gsd_m, mosaic_grid, write_mosaic
from core.errors import BadCheckpoints
from core.frame import FrameMeta
from core.fusion import FrameIndex, render
from core.geometry import Array, Camera, Pose, PosedFrame, World
from core.grid import UtmGrid
from core.mosaic_points import Lookup, look_up, mosaic_document, mosaic_errors, mosaic_points
from core.pose_graph import GraphFrame, PoseParams
from core.pose_graph.control import control_of, laid_onto
from core.pose_graph.residuals import State
from core.pose_graph.survey import survey as survey_of

CAMERA = Camera(400, 300, 300.0, 199.5, 149.5, k1=-0.02)
WORLD = World(47.0, 10.4, 400.0)
DOWN = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
POINTS = {"a": (12.0, 6.0), "b": (41.0, 31.0), "c": (66.0, 8.0), "d": (6.0, 37.0), "e": (68.0, 36.0)}
Pixels = NDArray[np.uint8]


def shot(x: float, y: float, height: float, yaw: float) -> PosedFrame:
    rotation = Rotation.from_euler("zxy", [yaw, 0.03, -0.02]).as_matrix() @ DOWN
    return PosedFrame(
        f"{round(x):03}{round(y):03}.jpg", CAMERA, Pose(rotation, np.array([x, y, height]), 0.0)
    )


FLIGHT = [shot(25.0 * i, 20.0 * j, 60 + i, 0.3 + 3 * j) for i in range(4) for j in range(3)]


@cache
def ground(rows_of_crops: bool) -> Pixels:
    """A land of 0.1 m pixels, 200 m wide: no two places look alike, or nothing but rows 2.4 m apart."""
    if rows_of_crops:
        wave = 128 + 60 * np.sin(np.arange(2000) * 2 * np.pi / 24)
        return np.ascontiguousarray(np.broadcast_to(wave[None, :, None], (2000, 2000, 3)).astype(np.uint8))
    rng = np.random.default_rng(4)
    layers = [cv2.resize(rng.normal(0, 1, (n, n, 3)), (2000, 2000)) for n in (20, 80, 400, 1000)]
    return np.clip(128 + 30 * sum(layers), 0, 255).astype(np.uint8)


@cache
def taken(frame_id: str, rows_of_crops: bool) -> Pixels:
    """A photo of the ground as a perfect camera takes it."""
    frame = next(f for f in FLIGHT if f.frame_id == frame_id)
    rows, cols = np.mgrid[: CAMERA.height, : CAMERA.width]
    uv = np.column_stack((cols.ravel(), rows.ravel())).astype(float)
    xy = ((frame.pose.ground(CAMERA, uv)[:, :2] + 60) * 10 - 0.5).astype(np.float32)
    x, y = xy.T.reshape(2, CAMERA.height, CAMERA.width)
    return np.asarray(cv2.remap(ground(rows_of_crops), x, y, cv2.INTER_LINEAR), np.uint8)


@dataclass(frozen=True)
class Land:
    """The photos of the flight."""

    rows_of_crops: bool = False

    def photo(self, frame_id: str) -> Pixels:
        return taken(frame_id, self.rows_of_crops)

    def thumb(self, frame_id: str) -> Pixels:
        small = cv2.resize(self.photo(frame_id), (128, 96), interpolation=cv2.INTER_AREA)
        return np.asarray(small, np.uint8)


def survey(
    shift: tuple[float, float] = (0, 0), height: float = 0.0, names: dict[str, tuple[float, float]] = POINTS
) -> Checkpoints:
    """The points marked where each photo really shows them; their survey off by metres."""
    to_crs = Transformer.from_crs(4326, 32632, always_xy=True)
    lines = ["EPSG:32632"]
    for k, (name, (x, y)) in enumerate(names.items()):
        lon, lat, alt = WORLD.to_geodetic(np.array([[x, y, 0.0]]))[0]
        east, north = to_crs.transform(lon, lat)
        place = f"{east + shift[0]:.5f} {north + shift[1]:.5f} {alt + height + 1e-4 * k:.5f}"
        for f in FLIGHT:
            u, v = f.pose.pixels(CAMERA, np.array([[x, y, 0.0]]))[0]
            if 0 < u < CAMERA.width - 1 and 0 < v < CAMERA.height - 1:
                lines.append(f"{place} {u:.4f} {v:.4f} {f.frame_id} {name}")
    return parse_gcp_list("\n".join(lines))


def frames_of(frames: list[PosedFrame]) -> dict[str, PosedFrame]:
    return by_name((f.frame_id, f) for f in frames)


GRID = mosaic_grid(WORLD, FLIGHT, flight_gsd_m(FLIGHT), 10**9)
LAND = Land()
Picture = Callable[[UtmGrid], Pixels]


def mosaic_of(frames: list[PosedFrame], land: Land = LAND) -> Picture:
    index = FrameIndex(frames)
    return lambda window: render(window, WORLD, index.overlapping(window, WORLD), land)


def looked_up(points: Checkpoints, picture: Picture, land: Land = LAND) -> list[Lookup]:
    seen = observations(points, WORLD, frames_of(FLIGHT))
    return look_up(seen, WORLD, GRID, picture, land.photo)


@pytest.fixture(scope="module")
def found() -> list[Lookup]:
    return looked_up(survey(), mosaic_of(FLIGHT))


def moved(frame: PosedFrame, x_m: float, y_m: float, z_m: float = 0.0) -> PosedFrame:
    pose = frame.pose
    place = replace(pose, center=pose.center + np.array([x_m, y_m, z_m]), ground_h_m=pose.ground_h_m + z_m)
    return replace(frame, pose=place)


# ---- in the mosaic


def test_a_true_map_shows_every_point_where_it_is(found: list[Lookup]) -> None:
    shown = mosaic_points(survey(), found, GRID.epsg)
    errors = mosaic_errors(survey(), shown, GRID.epsg)
    assert errors is not None
    assert (errors.points, errors.found) == (5, 5)
    assert errors.raw_m is not None
    assert errors.raw_m < 0.05  # a quarter of a pixel
    assert sum(p.found for p in shown.values()) > 0.8 * len(found)


def test_a_shifted_survey_is_raw_error_and_bias_alone(found: list[Lookup]) -> None:
    points = survey((3.0, -2.0))
    through = checkpoint_errors(points, WORLD, frames_of(FLIGHT))
    inside = mosaic_errors(points, mosaic_points(points, found, GRID.epsg), GRID.epsg)
    assert through is not None
    assert inside is not None
    for raw, debiased, bending in (
        (through.plane_raw_m, through.plane_debiased_m, through.plane_similarity_m),
        (inside.raw_m, inside.debiased_m, inside.similarity_m),
    ):
        assert raw == pytest.approx(13**0.5, abs=0.05)
        assert debiased == pytest.approx(0, abs=0.05)
        assert bending == pytest.approx(0, abs=0.05)


def test_it_is_the_picture_that_is_measured_not_the_poses() -> None:
    """A mosaic drawn 1.1 m too far east is found out, though every pose that is asked is right."""
    shown = mosaic_points(
        survey(), looked_up(survey(), mosaic_of([moved(f, 1.1, -0.7) for f in FLIGHT])), GRID.epsg
    )
    assert len(shown) == 5
    for point in shown.values():
        assert point.found
        assert (point.east_m, point.north_m) == (pytest.approx(1.1, abs=0.08), pytest.approx(-0.7, abs=0.08))


def test_the_windows_that_are_drawn_are_those_of_the_file(found: list[Lookup], tmp_path: Path) -> None:
    write_mosaic(tmp_path / "mosaic.tif", WORLD, FLIGHT, LAND)
    with rasterio.open(tmp_path / "mosaic.tif") as file:

        def cut(window: UtmGrid) -> Pixels:
            box = Window(window.col0, window.row0, window.width, window.height)
            return np.ascontiguousarray(file.read(window=box, boundless=True).transpose(1, 2, 0))

        from_file = looked_up(survey(), cut)
    assert [(k.outcome, k.score) for k in from_file] == [(k.outcome, k.score) for k in found]
    for one, other in zip(from_file, found, strict=True):
        np.testing.assert_array_equal(one.place, other.place)


def test_what_is_not_there_is_not_found() -> None:
    def nothing(window: UtmGrid) -> Pixels:
        return np.zeros((window.height, window.width, 4), np.uint8)

    def elsewhere(window: UtmGrid) -> Pixels:
        noise = np.random.default_rng(1).integers(0, 255, (window.height, window.width, 4), np.uint8)
        noise[..., 3] = 255
        return noise

    for picture, why in ((nothing, "outside"), (elsewhere, "poor")):
        looked = looked_up(survey(), picture)
        assert {k.outcome for k in looked} == {why}
        assert all(k.place is None for k in looked)
        shown = mosaic_points(survey(), looked, GRID.epsg)
        assert all((p.found, p.east_m) == (0, None) for p in shown.values())
        errors = mosaic_errors(survey(), shown, GRID.epsg)
        assert errors is not None
        assert (errors.points, errors.found, errors.raw_m) == (5, 0, None)


def test_rows_that_look_alike_are_not_told_apart() -> None:
    field = Land(rows_of_crops=True)
    looked = looked_up(survey(), mosaic_of(FLIGHT, field), field)
    assert "ambiguous" in {k.outcome for k in looked}
    assert "found" not in {k.outcome for k in looked}


def one_grey(rgba: Pixels) -> Pixels:
    """The same colours, all of them as bright."""
    grey = rgba[..., :3].astype(float) @ (0.299, 0.587, 0.114)
    rest = rgba[..., :3] - grey[..., None]
    return np.dstack((np.clip(128 + rest, 0, 255), rgba[..., 3:])).astype(np.uint8)


class Court(Land):
    """A land whose colours alone tell its places apart."""

    def photo(self, frame_id: str) -> Pixels:
        return one_grey(super().photo(frame_id))


def test_colours_tell_places_apart_that_are_equally_bright(found: list[Lookup]) -> None:
    drawn = mosaic_of(FLIGHT)
    looked = looked_up(survey(), lambda window: one_grey(drawn(window)), Court())
    assert {k.outcome for k in looked} == {"found"}
    for one, other in zip(looked, found, strict=True):
        assert np.hypot(*(one.place - other.place)) < 0.5 * GRID.gsd_m


def test_what_looks_otherwise_around_a_point_does_not_hide_it(found: list[Lookup]) -> None:
    """A fence beside the point leans the other way in the photo that the mosaic was drawn from."""
    points = survey(names={"b": POINTS["b"]})
    cols, rows = GRID.from_world(WORLD, np.array([POINTS["b"]]), 0.0)
    drawn = mosaic_of(FLIGHT)
    noise = np.random.default_rng(2).integers(0, 255, (GRID.height, GRID.width, 3), np.uint8)

    def fenced(window: UtmGrid) -> Pixels:
        picture = drawn(window).copy()
        y, x = np.mgrid[: window.height, : window.width]
        y, x = y + window.row0, x + window.col0
        away = np.maximum(abs(x - cols[0]), abs(y - rows[0])) > 14
        picture[away, :3] = noise[y[away] % GRID.height, x[away] % GRID.width]
        return picture

    looked = looked_up(points, fenced)
    expected = [k for k in found if k.point == "b"]
    assert {k.outcome for k in looked} == {"found"}
    for one, other in zip(looked, expected, strict=True):
        assert np.hypot(*(one.place - other.place)) < 0.5 * GRID.gsd_m


def test_the_report_names_every_point(found: list[Lookup]) -> None:
    names = POINTS | {"far": (5000.0, 0.0)}
    to_crs = Transformer.from_crs(4326, 32632, always_xy=True)
    lon, lat, _ = WORLD.to_geodetic(np.array([[5000.0, 0.0, 0.0]]))[0]
    east, north = to_crs.transform(lon, lat)
    rows = [
        f"{s.xyz[0]} {s.xyz[1]} {s.xyz[2]} {s.uv[0]} {s.uv[1]} {s.image} {s.point}"
        for s in survey().sightings
    ]
    points = parse_gcp_list("\n".join(["EPSG:32632", *rows, f"{east} {north} 3 5 5 gone.jpg far"])).using("b")
    shown = mosaic_points(points, found, GRID.epsg)
    inside = mosaic_document(shown, mosaic_errors(points, shown, GRID.epsg))
    posed = frames_of(FLIGHT)
    told = checkpoints_document(points, WORLD, posed, posed, inside)
    document = json.loads(json.dumps(told, allow_nan=False))
    assert [p["point"] for p in document["points"]] == sorted(names)
    assert [p["point"] for p in document["points"] if p["used"]] == ["b"]
    nowhere = {"point": "far", "used": False, "poses": None, "mosaic": None, "unseen": "no_photo"}
    assert document["points"][-1] == nowhere
    assert {p["unseen"] for p in document["points"][:-1]} == {None}
    assert (document["poses"]["points"], document["mosaic"]["points"]) == (4, 4)  # b does not check itself


def test_a_point_that_is_not_seen_says_why() -> None:
    points, posed = survey(), frames_of(FLIGHT)
    for frames, here, why in (({}, posed, "not_posed"), ({}, (), "no_photo"), (posed, posed, None)):
        told = checkpoints_document(points, WORLD, frames, here, None)
        assert {p["unseen"] for p in told["points"]} == {why}
        assert (told["poses"] is None, told["mosaic"]) == (why is not None, None)
    by_gps = {k: replace(f, pose=replace(f.pose, source="gnss")) for k, f in posed.items()}
    told = checkpoints_document(points, None, by_gps, by_gps, None)
    assert {p["unseen"] for p in told["points"]} == {"not_posed"}


# ---- the map laid onto points


def held(frames: list[PosedFrame], points: Checkpoints) -> list[PosedFrame]:
    meta = FrameMeta(CAMERA.width, CAMERA.height, CAMERA.f_px)
    graph = [GraphFrame(f.frame_id, f.frame_id, meta) for f in frames]
    known = survey_of(graph, PoseParams(), WORLD)
    control = control_of(known, marks_of(points, graph), PoseParams())
    if control is None:
        return frames
    poses = [{f.frame_id: f.pose for f in frames}[f.frame_id] for f in known.frames]
    before = State(
        np.array([p.world_R_cam for p in poses]),
        np.array([p.center for p in poses]),
        np.array([p.ground_h_m for p in poses]),
        np.array([(CAMERA.f_px, CAMERA.k1, CAMERA.k2)]),
        np.zeros(1),
    )
    after = laid_onto(control, before, PoseParams()).state(before)
    places = zip(known.frames, after.R, after.t, after.h, strict=True)
    moved_to = {f.frame_id: Pose(R, t, float(h)) for f, R, t, h in places}
    return [replace(f, pose=moved_to[f.frame_id]) for f in frames]


def warped(frame: PosedFrame, turn_rad: float, scale: float, shift: Array) -> PosedFrame:
    """The frame of a map that is turned, scaled and shifted as a whole."""
    turn = Rotation.from_euler("z", turn_rad).as_matrix()
    center = scale * turn @ frame.pose.center + shift
    pose = Pose(turn @ frame.pose.world_R_cam, center, scale * frame.pose.ground_h_m + shift[2])
    return replace(frame, pose=pose)


@given(
    st.floats(-0.02, 0.02), st.floats(0.99, 1.01), st.tuples(*[st.floats(-9, 9)] * 2, st.floats(-60, 60)),
    st.sets(st.sampled_from(sorted(POINTS)), min_size=2, max_size=4),
)  # fmt: skip
@settings(deadline=None, max_examples=40)
def test_chosen_points_undo_any_similarity(
    turn_rad: float, scale: float, shift: tuple[float, float, float], chosen: set[str]
) -> None:
    points = survey().using(chosen)
    wrong = [warped(f, turn_rad, scale, np.array(shift)) for f in FLIGHT]
    right = held(wrong, points)
    before = checkpoint_errors(points, WORLD, frames_of(wrong))
    after = checkpoint_errors(points, WORLD, frames_of(right))
    assert before is not None
    assert after is not None
    assert after.points == 5 - len(chosen)
    assert after.plane_raw_m <= 0.1 * before.plane_raw_m + 0.05
    assert after.raw_m < 0.1 * before.raw_m + 0.05  # heights follow, so rays meet the points' own too
    for now, then in zip(right, FLIGHT, strict=True):
        assert abs(now.pose.ground_h_m - then.pose.ground_h_m) < 0.01
        np.testing.assert_allclose(now.pose.world_R_cam @ now.pose.world_R_cam.T, np.eye(3), atol=1e-12)


@given(st.tuples(*[st.floats(-9, 9)] * 3), st.sampled_from(sorted(POINTS)))
@settings(deadline=None, max_examples=20)
def test_one_point_shifts_the_map_and_turns_nothing(shift: tuple[float, float, float], chosen: str) -> None:
    wrong = [moved(f, *shift) for f in FLIGHT]
    for now, was, then in zip(held(wrong, survey().using([chosen])), wrong, FLIGHT, strict=True):
        np.testing.assert_array_equal(now.pose.world_R_cam, was.pose.world_R_cam)
        np.testing.assert_allclose(now.pose.center, then.pose.center, atol=2e-3)


def test_one_wrong_mark_of_five_does_not_carry_the_map_away() -> None:
    points = survey()
    rows = [
        replace(s, xyz=(s.xyz[0] + 12.0, s.xyz[1], s.xyz[2])) if s.point == "c" else s
        for s in points.sightings
    ]
    right = held(FLIGHT, replace(points, sightings=tuple(rows)).using(POINTS))
    for now, then in zip(right, FLIGHT, strict=True):
        assert np.abs(now.pose.center - then.pose.center)[:2].max() < 0.3


def test_nothing_chosen_or_nothing_seen_changes_nothing_and_order_does_not_matter() -> None:
    wrong = [moved(f, 2.0, 1.0) for f in FLIGHT]
    assert held(wrong, survey()) == wrong
    points = survey().using(["a", "b", "e"])
    hidden = replace(points, sightings=tuple(replace(s, image="gone.jpg") for s in points.sightings))
    assert held(wrong, hidden) == wrong
    mixed = replace(points, sightings=points.sightings[::-1])
    for one, other in zip(held(wrong, points), held(wrong[::-1], mixed)[::-1], strict=True):
        np.testing.assert_array_equal(one.pose.center, other.pose.center)
        np.testing.assert_array_equal(one.pose.world_R_cam, other.pose.world_R_cam)


def test_placeholders_for_heights_move_no_height() -> None:
    points = survey()
    flat = tuple(replace(s, xyz=(*s.xyz[:2], 3.0)) for s in points.sightings)
    wrong = [moved(f, 2.0, 1.0) for f in FLIGHT]
    for now, then in zip(held(wrong, replace(points, sightings=flat).using("ab")), FLIGHT, strict=True):
        np.testing.assert_allclose(now.pose.center, then.pose.center, atol=0.02)
        assert now.pose.ground_h_m == pytest.approx(0, abs=1e-6)


# ---- the file


def test_fields_may_be_parted_by_tabs_commas_or_semicolons() -> None:
    plain = parse_gcp_list("EPSG:32632\n500000.5 5200000 7 1.5 2 a.jpg P1 more\n")
    for mark in ("\t", ",", ";", ", "):
        row = mark.join(["500000.5", "5200000", "7", "1.5", "2", "a.jpg", "P1"])
        assert parse_gcp_list(f"EPSG:32632\r\n{row}\r\n") == plain
    spaced = parse_gcp_list("EPSG:32632\n500000\t5200000\t7\t1\t2\tDJI 1.jpg\tpost 4\n")
    assert (spaced.sightings[0].image, spaced.points) == ("DJI 1.jpg", ["post 4"])


@pytest.mark.parametrize(
    ("content", "word"),
    [
        ("EPSG:32632\n# nothing more\n", "no point"),
        ("EPSG:32632\n1e30 5200000 7 1 2 a.jpg P1", "Line 2"),
        ("EPSG:5773\n7 5 7 1 2 a.jpg P1", "CRS"),
        ("EPSG:4326\n7 5200000 7 1 2 a.jpg P1", "Line 2"),
        ("EPSG:32632\n5\x000 5 7 1 2 a.jpg", "text"),
    ],
)
def test_a_file_that_cannot_be_meant_is_refused(content: str, word: str) -> None:
    with pytest.raises(BadCheckpoints, match=word):
        parse_gcp_list(content)


@given(st.text(max_size=200))
@settings(deadline=None, max_examples=40)
def test_any_text_is_read_or_refused(content: str) -> None:
    with suppress(BadCheckpoints):
        assert parse_gcp_list(f"EPSG:32632\n{content}").sightings


def test_a_point_that_the_file_does_not_hold_cannot_be_used() -> None:
    assert survey().using(["a", "b"]).used == {"a", "b"}
    with pytest.raises(BadCheckpoints, match="'z'"):
        survey().using(["a", "z"])


def test_photos_that_share_a_name_are_not_guessed_at() -> None:
    twins = by_name([("x/1.jpg", FLIGHT[0]), ("y/1.jpg", FLIGHT[1]), ("2.jpg", FLIGHT[2])])
    row = "500000 5200000 7 1 2"
    points = parse_gcp_list(
        f"EPSG:32632\n{row} 1.jpg P1\n{row} 2.JPG P1\n{row} x/1.jpg P1\n{row} C:\\2.jpg P1"
    )
    seen = [o.frame.frame_id for o in observations(points, WORLD, twins)]
    assert seen == [FLIGHT[k].frame_id for k in (2, 0, 2)]
    assert by_name([("1.jpg", FLIGHT[0]), ("1.jpg", FLIGHT[1])]) == {}
