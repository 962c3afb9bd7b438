"""Measures the whole program as a user runs it; one line of JSON a flight.

python -m tests.bench flight DIR [DIR …]     `orthostream run` on folders of photos
python -m tests.bench simulated              a simulated flight of known truth
Both take --cores (for taskset), --max-side, --pace (photos a second), --out, and --tools: a folder with
overlap_ncc.py, gcp_error.py and score_mosaic.py, whose lines are added to the figures.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import psutil

PROGRAM = [str(Path(sys.executable).with_name("orthostream"))]


def label(process: psutil.Process) -> str:
    """What a process of the tree is, from its command line."""
    line = " ".join(process.cmdline())
    for word, name in (
        ("valkey", "broker"),
        ("uvicorn", "api"),
        ("sequence", "sequencer"),
        ("celery", "workers"),
    ):
        if word in line:
            return name
    return "cli"


def watch(process: subprocess.Popen[bytes]) -> dict[str, Any]:
    """Follows a process tree until its root ends: peak PSS in MB and CPU seconds by kind of process."""
    peak, cpu = 0, dict[int, tuple[str, float]]()
    root = psutil.Process(process.pid)
    while process.poll() is None:
        total = 0
        try:
            for member in [root, *root.children(recursive=True)]:
                total += member.memory_full_info().pss
                times = member.cpu_times()
                cpu[member.pid] = (label(member), times.user + times.system)
        except psutil.NoSuchProcess:
            continue
        peak = max(peak, total)
        time.sleep(0.5)
    seconds = dict[str, float]()
    for name, spent in cpu.values():
        seconds[name] = round(seconds.get(name, 0.0) + spent, 2)
    return {"exit": process.returncode, "peak_pss_mb": round(peak / 1e6), "cpu_s": seconds}


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
    started = time.monotonic()
    process = subprocess.Popen(["taskset", "-c", options.cores, *command], stdout=subprocess.DEVNULL)
    figures = watch(process) | {"wall_s": round(time.monotonic() - started, 1)}
    report = out / "report.json"
    if report.exists():
        figures["report"] = json.loads(report.read_text())
        figures["report"].pop("rejected", None)
    return figures


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


def simulated(options: argparse.Namespace) -> dict[str, Any]:
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


def main() -> None:
    """Reads the arguments and prints one line of JSON a flight."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("flight", "simulated"))
    parser.add_argument("photos", nargs="*", type=Path)
    parser.add_argument("--cores", default="0,1")
    parser.add_argument("--max-side", type=int)
    parser.add_argument("--pace", type=float)
    parser.add_argument("--out", type=Path, default=Path("out/bench"))
    parser.add_argument("--tools", type=Path)
    parser.add_argument(
        "--simulate", default="--frames 200 --gps-noise-m 2", help="options of `orthostream simulate`"
    )
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    if options.what == "simulated":
        print(json.dumps(simulated(options)), flush=True)
    for photos in options.photos:
        print(json.dumps(flight(photos, options)), flush=True)


if __name__ == "__main__":
    main()
