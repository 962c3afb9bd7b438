"""The program `orthostream` as a user runs it: results, bad input, Ctrl-C, and running it again."""

from __future__ import annotations

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil
import pytest
import rasterio
from PIL import Image

from core.simulation import FlightParams
from workers.simulate import simulate

PROGRAM = [sys.executable, "-m", "services.cli"]
FILES = {"mosaic.tif", "tiles.pmtiles", "poses.json", "report.json", "footprints.geojson", "route.csv"}


def orthostream(*arguments: Path | str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*PROGRAM, *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        env={**os.environ, "COLUMNS": "200", "ORTHOSTREAM_WORKERS": "2"},
    )


def test_a_folder_becomes_a_map_and_a_second_run_goes_on_from_there(flight: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = orthostream("run", flight, "--out", out)
    assert done.returncode == 0, done.stdout + done.stderr
    assert {p.name for p in out.iterdir()} == FILES | {".orthostream"}
    assert str(out / "mosaic.tif") in done.stdout
    with rasterio.open(out / "mosaic.tif") as mosaic:
        assert mosaic.count == 4
        assert mosaic.overviews(1)
        assert (mosaic.read(4) == 255).mean() > 0.3
    poses = json.loads((out / "poses.json").read_text())
    assert sorted(f["name"] for f in poses["frames"]) == sorted(p.name for p in flight.iterdir())
    assert {f["source"] for f in poses["frames"]} == {"visual"}
    report = json.loads((out / "report.json").read_text())
    assert report["counts"]["fused"] == 14
    assert report["mission"]["state"] == "final"
    assert report["reprojection_rms_px"] < 3
    assert {"ingest", "match", "fuse", "publish"} <= report["stage_seconds"].keys()
    assert len(list(csv.DictReader((out / "route.csv").open()))) == 14
    assert len(json.loads((out / "footprints.geojson").read_text())["features"]) == 14

    pixels = (out / "mosaic.tif").read_bytes()
    begin = time.monotonic()
    again = orthostream("run", flight, "--out", out)
    assert again.returncode == 0, again.stdout + again.stderr
    assert time.monotonic() - begin < 20
    assert json.loads((out / "report.json").read_text())["mission"]["id"] == report["mission"]["id"]
    assert (out / "mosaic.tif").read_bytes() == pixels


def test_bad_files_are_named_and_the_rest_is_mapped(flight: Path, tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    shutil.copytree(flight, photos)
    whole = (photos / "D1_0001.jpg").read_bytes()
    (photos / "empty.jpg").write_bytes(b"")
    (photos / "notes.jpg").write_bytes(b"these are no pixels")
    (photos / "torn.jpg").write_bytes(whole[: len(whole) // 2])
    (photos / "copy.jpg").write_bytes(whole)
    (photos / "readme.txt").write_text("not a photo")
    Image.new("RGB", (640, 480), (90, 120, 60)).save(photos / "nowhere.jpg")
    done = orthostream("run", photos, "--out", tmp_path / "out")
    assert done.returncode == 0, done.stdout + done.stderr
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    codes = {r["name"]: r["code"] for r in report["rejected"]}
    assert codes == {
        "empty.jpg": "empty_file",
        "notes.jpg": "not_an_image",
        "torn.jpg": "truncated_image",
    }
    assert [w["name"] for w in report["waiting"]] == ["nowhere.jpg"]
    assert "wait for a tie" in done.stdout
    for name in codes:
        assert f"rejected {name}" in done.stdout
    assert report["counts"]["fused"] == 14


@pytest.mark.parametrize("kind", ["missing", "empty", "file", "nothing good"])
def test_nothing_to_map_ends_with_exit_2_and_what_to_do(tmp_path: Path, kind: str) -> None:
    photos = tmp_path / "photos"
    if kind in ("empty", "nothing good"):
        photos.mkdir()
    if kind == "file":
        photos.write_text("no folder")
    if kind == "nothing good":
        (photos / "a.jpg").write_bytes(b"no photo")
        Image.new("RGB", (640, 480)).save(photos / "b.jpg")
    done = orthostream("run", photos, "--out", tmp_path / "out")
    assert done.returncode == 2, done.stdout + done.stderr
    said = done.stdout + done.stderr
    assert "Traceback" not in said
    assert ("a.jpg" in said and "b.jpg" in said) if kind == "nothing good" else str(photos) in said


def test_ctrl_c_stops_everything_and_the_next_run_finishes(flight: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    command = [*PROGRAM, "run", str(flight), "--out", str(out), "--pace", "4"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    mission = out / ".orthostream" / "mission.json"
    while not mission.exists():
        assert process.poll() is None
        time.sleep(0.05)
    while len(tree := psutil.Process(process.pid).children(recursive=True)) < 6:
        assert process.poll() is None  # the pools are forked when their parents are warm
        time.sleep(0.05)
    begin = time.monotonic()
    process.send_signal(signal.SIGINT)
    assert process.wait(20) == 130
    assert time.monotonic() - begin < 8
    assert not [p for p in tree if p.is_running() and p.status() != psutil.STATUS_ZOMBIE]
    before = json.loads(mission.read_text())["mission"]
    done = orthostream("run", flight, "--out", out)
    assert done.returncode == 0, done.stdout + done.stderr
    report = json.loads((out / "report.json").read_text())
    assert report["mission"]["id"] == before
    assert report["counts"]["fused"] == report["frames"] == 14


def test_a_second_serve_on_the_same_folder_is_refused(new_stack: Callable[..., Any]) -> None:
    stack = new_stack().start()
    second = orthostream("serve", "--data-dir", stack.data_dir, "--port", "0")
    assert second.returncode == 2
    assert stack.url in second.stderr
    assert stack.stop() < 6
    assert stack.nobody_left()


def test_without_gps_a_first_height_gives_a_local_map_that_says_so(tmp_path: Path) -> None:
    params = FlightParams(
        drones=1, lines=1, per_line=4, width_px=480, height_px=360, no_gps=1.0, xmp=False, seed=8
    )
    simulate(params, tmp_path, jobs=2, truth=False)
    photos, out = tmp_path / "images", tmp_path / "out"
    for wrong in ("nowhere.jpg:1,2,90,80:4", "D1_0001.jpg:4"):
        refused = orthostream("run", photos, "--out", out, "--marker", wrong)
        assert refused.returncode == 2
        assert "marker" in refused.stderr
    done = orthostream("run", photos, "--out", out, "--first-height", "90")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "Not georeferenced" in done.stdout
    assert "what you gave" in done.stdout
    report = json.loads((out / "report.json").read_text())
    assert (report["georeferenced"], report["counts"]["fused"]) == (False, 4)
    assert report["scale"] == {"first_height_m": 90.0, "marker": None, "used": True}
    heights = [float(r["height_above_ground"]) for r in csv.DictReader((out / "route.csv").open())]
    assert heights[0] == pytest.approx(90.0, rel=0.03)
    with rasterio.open(out / "mosaic.tif") as mosaic:
        assert "Not georeferenced" in mosaic.tags()["TIFFTAG_IMAGEDESCRIPTION"]


def test_gnss_mode_needs_no_matches(flight: Path, tmp_path: Path) -> None:
    one = tmp_path / "one"
    one.mkdir()
    shutil.copy(flight / "D1_0001.jpg", one)
    done = orthostream("run", one, "--out", tmp_path / "out", "--mode", "gnss", "--max-side", "320")
    assert done.returncode == 0, done.stdout + done.stderr
    poses = json.loads((tmp_path / "out" / "poses.json").read_text())
    assert [f["source"] for f in poses["frames"]] == ["gnss"]
