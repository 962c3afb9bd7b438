"""Measures the whole program as a user runs it, and its poses against the truth; one line of JSON a flight.

python -m tests.bench flight DIR [DIR …]     `orthostream run` on folders of photos
python -m tests.bench rendered               `orthostream run` on a simulated flight of known truth
python -m tests.bench simulated              poses in every situation of a flight (--frames, --seeds)
The first two take --cores (for taskset), --max-side, --pace (photos a second), --out, and --tools: a folder
with overlap_ncc.py, gcp_error.py and score_mosaic.py, whose lines are added to the figures.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path
from typing import Any

from tests.bench.situations import situations
from tests.bench.watch import watch

PROGRAM = [str(Path(sys.executable).with_name("orthostream"))]


def scored(tools: Path | None, script: str, *arguments: Path | str) -> dict[str, Any]:
    """The JSON line of one measuring script; nothing when no tools were named."""
    if tools is None:
        return {}
    command = [sys.executable, str(tools / script), *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    lines = done.stdout.strip().splitlines()
    return {script.removesuffix(".py"): json.loads(lines[-1]) if lines else done.stderr[-200:]}


def run(photos: Path, out: Path, options: argparse.Namespace) -> dict[str, Any]:
    """One `orthostream run`, watched from outside, with the figures of its own report."""
    shutil.rmtree(out, ignore_errors=True)
    command = [*PROGRAM, "run", str(photos), "--out", str(out)]
    command += ["--max-side", str(options.max_side)] if options.max_side else []
    command += ["--pace", str(options.pace)] if options.pace else []
    gcp = photos.parent / "gcp_list.txt"
    command += ["--gcp", str(gcp)] if gcp.exists() else []
    seen = watch(["taskset", "-c", options.cores, *command])
    figures = {"exit": seen.exit, "wall_s": seen.wall_s, "peak_pss_mb": seen.peak_pss_mb}
    report = out / "report.json"
    if not report.exists():
        return figures | {"cpu_s": {"all": seen.cpu_s()}}
    said = json.loads(report.read_text())
    said.pop("rejected", None)
    uploaded, shown = milestones(out)
    cpu_s = {
        "before_first_upload": seen.cpu_s(until=uploaded),
        "until_last_tile": seen.cpu_s(uploaded, shown),
        "exports": seen.cpu_s(since=shown),
    }
    return figures | {"cpu_s": cpu_s} | rates(photos, said, shown - uploaded) | {"report": said}


def milestones(out: Path) -> tuple[float, float]:
    """When the first photo came and when the last tile was shown: seconds since the epoch."""
    with closing(sqlite3.connect(out / ".orthostream" / "orthostream.db")) as db:
        query = "SELECT first_upload_at, last_tile_at FROM missions ORDER BY created_at DESC LIMIT 1"
        first, last = db.execute(query).fetchone()
    return float(first), float(last)


def rates(photos: Path, report: dict[str, Any], seconds: float) -> dict[str, Any]:
    """How fast the service was from the first upload to the last tile, and what a photo cost each stage."""
    frames = max(report["frames"], 1)
    size_mb = sum(p.stat().st_size for p in photos.rglob("*") if p.is_file()) / 1e6
    budget = {name: round(1000 * s / frames, 1) for name, s in report["stage_seconds"].items()}
    return {
        "upload_to_last_tile_s": round(seconds, 2),
        "frames_per_s": round(frames / seconds, 2),
        "mb_per_s": round(size_mb / seconds, 2),
        "stage_ms_a_frame": budget,
    }


def flight(photos: Path, options: argparse.Namespace) -> dict[str, Any]:
    """A folder of real photos: `images/` inside it when there is one."""
    images = photos / "images" if (photos / "images").is_dir() else photos
    out = options.out / photos.name
    figures = {"flight": photos.name, "cores": options.cores} | run(images, out, options)
    figures |= scored(options.tools, "overlap_ncc.py", out / "poses.json", images)
    for truth in ("ref_obs.txt", "gcp_list.txt"):
        if (photos / truth).exists():
            score = scored(options.tools, "gcp_error.py", out / "poses.json", photos / truth)
            figures |= {truth: next(iter(score.values()), None)}
    return figures


def rendered(options: argparse.Namespace) -> dict[str, Any]:
    """A flight of known truth: simulated, mapped, held against its own ground."""
    photos, out = options.out / "simulated-photos", options.out / "simulated"
    shutil.rmtree(photos, ignore_errors=True)
    simulate = [*PROGRAM, "simulate", "--out", str(photos), *options.simulate.split()]
    subprocess.run(simulate, check=True, stdout=subprocess.DEVNULL)
    figures = {"flight": f"simulated {options.simulate}", "cores": options.cores} | run(
        photos / "images", out, options
    )
    truth = ("--area", photos / "truth.json")
    return figures | scored(
        options.tools, "score_mosaic.py", out / "mosaic.tif", photos / "truth.tif", *truth
    )


def seeds(text: str) -> range:
    """A range of seeds as `--seeds` names it."""
    first, _, last = text.partition("-")
    return range(int(first), int(last or first) + 1)


def main() -> None:
    """Reads the arguments and prints one line of JSON a flight."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("flight", "rendered", "simulated"))
    parser.add_argument("photos", nargs="*", type=Path)
    parser.add_argument("--cores", default="0,1")
    parser.add_argument("--max-side", type=int)
    parser.add_argument("--pace", type=float)
    parser.add_argument("--out", type=Path, default=Path("out/bench"))
    parser.add_argument("--tools", type=Path)
    parser.add_argument(
        "--simulate", default="--frames 200 --gps-noise-m 2", help="options of `orthostream simulate`"
    )
    parser.add_argument("--frames", type=int, default=200, help="of the simulated flights")
    parser.add_argument("--seeds", type=seeds, default=range(5), help="of the simulated flights: 3 or 0-19")
    options = parser.parse_args()
    if options.what == "simulated":
        for line in situations(options.frames, options.seeds):
            print(json.dumps(line), flush=True)
        return
    options.out.mkdir(parents=True, exist_ok=True)
    if options.what == "rendered":
        print(json.dumps(rendered(options)), flush=True)
    for photos in options.photos:
        print(json.dumps(flight(photos, options)), flush=True)


if __name__ == "__main__":
    main()
