"""Surveyed points through the whole program: measured in its mosaic, and the map held in place by some."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from core.simulation import FlightParams, plan_flight
from workers.simulate import simulate

Run = Callable[..., tuple[str, dict[str, Any]]]
BIAS = (3.0, -2.0)
PARAMS = FlightParams(
    frames=12, drones=1, width_px=640, height_px=480, gps_noise_m=0.3, seed=6, monotony=0.0, cars=0
)


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("surveyed")
    simulate(PARAMS, out, jobs=2, truth=False)
    return out / "images"


@pytest.fixture(scope="module")
def gcp(photos: Path) -> Path:
    """What the photos really show at the middle of every third, the survey shifted by `BIAS`."""
    flight = plan_flight(PARAMS)
    lines = [f"EPSG:{flight.epsg}"]
    for number, shot in enumerate(flight.shots[::3]):
        middle = np.array([[shot.camera.cx, shot.camera.cy]])
        (place,) = flight.ground(shot, middle)
        for other in flight.shots:
            u, v = other.pose.pixels(other.camera, place[None])[0]
            if 20 < u < other.camera.width - 20 and 20 < v < other.camera.height - 20:
                east, north = place[:2] + BIAS
                where = f"{east:.3f} {north:.3f} {place[2] + number / 1e3:.3f}"
                lines.append(f"{where} {u:.2f} {v:.2f} {other.name} P{number}")
    path = photos.parent / "gcp_list.txt"
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.fixture
def run(photos: Path, new_stack: Callable[..., Any]) -> Run:
    """`orthostream run` on a server that is up already: what it says, and its report."""
    url = new_stack().start().url

    def run(out: Path, *options: str | Path) -> tuple[str, dict[str, Any]]:
        command = ["run", str(photos), "--out", str(out), "--server", url, *map(str, options)]
        done = subprocess.run(
            [sys.executable, "-m", "services.cli", *command],
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
            env={**os.environ, "COLUMNS": "200"},
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout, json.loads((out / "report.json").read_text())

    return run


def test_points_measure_the_map_and_chosen_ones_hold_it(run: Run, gcp: Path, tmp_path: Path) -> None:
    said, report = run(tmp_path / "a", "--gcp", gcp)
    assert "checkpoints, mosaic" in said
    checked = report["checkpoints"]
    assert [p["point"] for p in checked["points"]] == ["P0", "P1", "P2", "P3"]
    for raw_m in (checked["poses"]["plane_raw_m"], checked["mosaic"]["raw_m"]):
        assert raw_m == pytest.approx(math.hypot(*BIAS), abs=0.8)  # GPS of 0.3 m a photo
    assert checked["mosaic"]["found"] == 4
    assert checked["mosaic"]["debiased_m"] < 0.6
    free = (tmp_path / "a" / "mosaic.tif").read_bytes()

    said, report = run(tmp_path / "a", "--gcp", gcp, "--use-gcp", "P0,P1,P3")
    assert "P0, P1, P3" in said
    held = report["checkpoints"]
    assert [p["point"] for p in held["points"] if p["used"]] == ["P0", "P1", "P3"]
    assert held["poses"]["points"] == 1
    assert max(held["poses"]["plane_raw_m"], held["poses"]["raw_m"], held["mosaic"]["raw_m"]) < 0.5
    mosaic = (tmp_path / "a" / "mosaic.tif").read_bytes()
    assert mosaic != free

    _, report = run(tmp_path / "b", "--gcp", gcp, "--use-gcp", "P3", "--use-gcp", "P1,P0")
    assert (tmp_path / "b" / "mosaic.tif").read_bytes() == mosaic
    assert report["checkpoints"] == held
