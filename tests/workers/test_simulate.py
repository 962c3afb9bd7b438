"""The program that writes a simulated flight."""

import json
import subprocess
import sys

import pytest
import rasterio

OPTIONS = [
    "--frames",
    "5",
    "--drones",
    "2",
    "--width",
    "320",
    "--height",
    "240",
    "--height-m",
    "30",
    "--no-gps",
    "0.5",
    "--seed",
    "4",
    "--events",
]


def simulate(out, *more):
    command = [sys.executable, "-m", "workers.simulate", "--out", str(out), *OPTIONS, *more]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_a_flight_is_written_whole_and_the_same_by_any_number_of_processes(tmp_path):
    done = [simulate(tmp_path / name, "--jobs", jobs) for name, jobs in (("a", "1"), ("b", "2"))]
    lines = [json.loads(line) for line in done[0].stdout.splitlines()]
    names = [line["name"] for line in lines[:-1]]
    assert lines[-1]["photos"] == 5
    assert [f["name"] for f in json.loads((tmp_path / "a/truth.json").read_text())["frames"]] == names
    assert sorted(p.name for p in (tmp_path / "a/images").iterdir()) == sorted(names)
    assert sorted(p.name for p in (tmp_path / "a").iterdir()) == ["images", "truth.json", "truth.tif"]
    for name in names:
        assert (tmp_path / "a/images" / name).read_bytes() == (tmp_path / "b/images" / name).read_bytes()
    with rasterio.open(tmp_path / "a/truth.tif") as a, rasterio.open(tmp_path / "b/truth.tif") as b:
        assert (a.read() == b.read()).all()
        assert a.read().std() > 10


@pytest.mark.parametrize("wrong", [["--drones", "0"], ["--side-overlap", "1.5"], ["--layout", "heap"]])
def test_options_that_make_no_sense_are_refused_with_a_sentence(tmp_path, wrong):
    done = simulate(tmp_path, *wrong)
    assert done.returncode == 2
    assert "error:" in done.stderr
    assert list(tmp_path.iterdir()) == []
