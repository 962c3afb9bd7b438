"""Whatever lies on a drone's card: the program says which file, why and what to do, and maps the rest."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
import simplejpeg
from PIL import Image

from core.frame import GpsFix
from core.metadata import read_metadata
from core.photo import probe
from core.photo_writer import PhotoTags, write_photo
from core.simulation import FlightParams
from services.processes import running_url
from workers.simulate import simulate

PROGRAM = [sys.executable, "-m", "services.cli"]
ENVIRONMENT = {
    **os.environ,
    "COLUMNS": "200",
    "ORTHOSTREAM_WORKERS": "2",
    "ORTHOSTREAM_MIN_FREE_BYTES": "0",
    "OMP_NUM_THREADS": "1",
}
SMALL = {"width_px": 640, "height_px": 480, "drones": 1}


def orthostream(*arguments: Path | str, **settings: str) -> subprocess.CompletedProcess[str]:
    """One command; never a traceback, and never longer than a minute."""
    command = [*PROGRAM, *map(str, arguments)]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=60, check=False, env=ENVIRONMENT | settings
    )
    assert "Traceback" not in done.stdout + done.stderr
    return done


def fly(out: Path, **params: Any) -> list[Path]:
    """Simulated photos in capture order."""
    simulate(FlightParams(**SMALL | params), out, jobs=2, truth=False)
    return sorted((out / "images").iterdir())


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    return fly(tmp_path_factory.mktemp("flight"), lines=3, per_line=5, seed=3)


@pytest.fixture(scope="module")
def elsewhere(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Another country's ground."""
    out = tmp_path_factory.mktemp("elsewhere")
    return fly(out, lines=2, per_line=3, seed=9, lat_deg=-33.9, lon_deg=151.2)


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    data_dir = tmp_path_factory.mktemp("server") / "data"
    command = [*PROGRAM, "serve", "--data-dir", str(data_dir), "--port", "0"]
    with (data_dir.parent / "serve.log").open("wb") as log:
        process = subprocess.Popen(command, env=ENVIRONMENT, stdout=log, stderr=log, start_new_session=True)
    give_up_at = time.monotonic() + 60
    while (url := running_url(data_dir, process.pid)) is None:
        assert process.poll() is None
        assert time.monotonic() < give_up_at
        time.sleep(0.05)
    try:
        yield url
    finally:
        process.terminate()
        process.wait(20)


def retagged(
    path: Path, picture: np.ndarray[Any, Any] | None = None, quality: int = 92, **tags: Any
) -> bytes:
    """The photo with other metadata; a value may be a function of what it was."""
    data = path.read_bytes()
    meta = read_metadata(data, probe(data))
    assert meta.captured_s is not None
    assert meta.f_px is not None
    was = PhotoTags(
        meta.captured_s, meta.f_px, meta.drone, meta.gps, meta.relative_alt_m, meta.attitude, xmp=True
    )
    now = {name: value(getattr(was, name)) if callable(value) else value for name, value in tags.items()}
    pixels = simplejpeg.decode_jpeg(data) if picture is None else picture
    return write_photo(np.ascontiguousarray(pixels), replace(was, **now), quality)


def jpeg_header(width: int, height: int) -> bytes:
    """A JPEG that claims a size and has hardly a pixel."""
    frame = struct.pack(">BHHB", 8, height, width, 3) + bytes([1, 0x22, 0, 2, 0x11, 1, 3, 0x11, 1])
    scan = bytes([3, 1, 0, 2, 0x11, 3, 0x11, 0, 63, 0])
    segments = [(0xC0, frame), (0xDA, scan)]
    body = b"".join(b"\xff" + bytes([m]) + struct.pack(">H", len(s) + 2) + s for m, s in segments)
    return b"\xff\xd8" + body + bytes(200) + b"\xff\xd9"


def tiff_header(width: int, height: int) -> bytes:
    """A TIFF that claims a size and has no pixel at all."""
    tags = {256: width, 257: height, 258: 8, 259: 1, 262: 1, 273: 8, 277: 1, 278: height, 279: width * height}
    directory = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags.items())
    return b"II*\x00" + struct.pack("<IH", 8, len(tags)) + directory + bytes(4)


def resaved(path: Path, kind: str, mode: str = "RGB", orientation: int = 1) -> bytes:
    """The same photo as another kind of file, metadata kept."""
    with Image.open(path) as image:
        exif = image.getexif()
        exif[0x0112] = orientation
        packet = {"xmp": image.info["xmp"]} if kind == "JPEG" else {}
        out = BytesIO()
        image.convert(mode).save(
            out, kind, quality=92, exif=exif if kind == "TIFF" else exif.tobytes(), **packet
        )
    return out.getvalue()


def half_size(path: Path) -> np.ndarray[Any, Any]:
    """The picture as a smaller camera would have taken it."""
    with Image.open(path) as image:
        return np.asarray(image.resize((image.width // 2, image.height // 2)))


def results(out: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """report.json, and the frames of poses.json by name."""
    poses = json.loads((out / "poses.json").read_text())
    return json.loads((out / "report.json").read_text()), {f["name"]: f for f in poses["frames"]}


REFUSED = {
    "text.jpg": "not_an_image",
    "empty [red].jpg": "empty_file",
    "torn.jpg": "truncated_image",
    "stump.jpg": "truncated_image",
    "bomb.jpg": "too_many_pixels",
    "bomb.tif": "too_many_pixels",
    "thumb.jpg": "too_few_pixels",
    "huge.jpg": "file_too_large",
    "sydney.jpg": "far_from_mission",
}


def odd_photos(flight: list[Path], card: Path) -> set[str]:
    """Puts the flight onto the card, most of its photos changed; the names of those that can be mapped."""
    for path in flight:
        shutil.copy(path, card)
    at = {k: card / path.name for k, path in enumerate(flight)}
    at[1].write_bytes(retagged(flight[1], gps=None))
    at[2].write_bytes(retagged(flight[2], gps=GpsFix(0.0, 0.0, 0.0), xmp=False))
    at[3].write_bytes(retagged(flight[3], captured_s=0.0))
    at[4].write_bytes(retagged(flight[4], captured_s=4.0e9))
    at[5].write_bytes(retagged(flight[5], attitude=lambda a: replace(a, pitch_rad=0.0)))
    at[6].write_bytes(resaved(flight[6], "JPEG", "L"))
    at[7].write_bytes(resaved(flight[7], "JPEG", orientation=6))
    at[10].write_bytes(retagged(flight[10], half_size(flight[10]), f_px=lambda f: f / 2, serial="B"))
    at[8].unlink()
    at[8].with_suffix(".tif").write_bytes(resaved(flight[8], "TIFF"))
    (card / "DCIM").mkdir()
    at[9].rename(card / "DCIM" / at[10].name)  # two folders, one name
    os.rename(at[11], os.fsencode(card) + b"/bad\xff[b]name.jpg")
    as_they_are = {p.name for p in flight} - {flight[k].name for k in (5, 8, 9, 11)}
    return as_they_are | {at[8].with_suffix(".tif").name, "bad�[b]name.jpg", f"DCIM_{flight[10].name}"}


def no_photos(flight: list[Path], elsewhere: list[Path], card: Path) -> None:
    """Puts onto the card what cannot be mapped, and what is there already."""
    whole = flight[0].read_bytes()
    (card / "text.jpg").write_text("no photo")
    (card / "empty [red].jpg").write_bytes(b"")
    (card / "torn.jpg").write_bytes(whole[: len(whole) // 2])
    (card / "stump.jpg").write_bytes(whole[:300])
    (card / "bomb.jpg").write_bytes(jpeg_header(20_000, 20_000))
    (card / "bomb.tif").write_bytes(tiff_header(20_000, 20_000))
    Image.new("RGB", (48, 36)).save(card / "thumb.jpg")
    with (card / "huge.jpg").open("wb") as huge:
        huge.write(whole)
        huge.truncate(201_000_000)
    shutil.copy(elsewhere[0], card / "sydney.jpg")
    (card / "stranger.jpg").write_bytes(retagged(elsewhere[4], gps=None))
    (card / "copy.jpg").write_bytes(whole)
    (card / "gone.jpg").symlink_to("nowhere")
    Image.new("RGB", (640, 480)).save(card / "screen.png")


def test_one_card_with_everything_on_it(
    flight: list[Path], elsewhere: list[Path], server: str, tmp_path: Path
) -> None:
    card, out = tmp_path / "card [bold] № 1", tmp_path / "out"
    card.mkdir()
    names = odd_photos(flight, card)
    no_photos(flight, elsewhere, card)
    done = orthostream("run", card, "--out", out, "--server", server)
    assert done.returncode == 0, done.stdout + done.stderr
    report, placed = results(out)
    assert {r["name"]: r["code"] for r in report["rejected"]} == REFUSED | {flight[5].name: "oblique"}
    assert [w["name"] for w in report["waiting"]] == ["stranger.jpg"]
    for rejected in report["rejected"]:
        assert f"rejected {rejected['name']}: {rejected['reason']}" in done.stdout
        # why, and what to do: two sentences
        assert re.match(r".{20,}\. [A-Z].{10,}\.$", rejected["reason"]), rejected["reason"]
    assert placed.keys() == names
    assert {f["source"] for f in placed.values()} == {"visual"}
    assert "copy.jpg (= " in done.stdout or "(= copy.jpg)" in done.stdout
    assert "screen.png" in done.stdout


def no_gps(flight: list[Path], elsewhere: list[Path]) -> dict[str, bytes]:
    return {p.name: retagged(p, gps=None) for p in flight[:6]}


def one_picture(flight: list[Path], elsewhere: list[Path]) -> dict[str, bytes]:
    return {f"copy{q}.jpg": retagged(flight[0], quality=q) for q in (84, 88, 92, 96)}


def one_photo(flight: list[Path], elsewhere: list[Path]) -> dict[str, bytes]:
    return {"only.jpg": flight[0].read_bytes()}


def two_strangers(flight: list[Path], elsewhere: list[Path]) -> dict[str, bytes]:
    """Two that show different ground, side by side by their GPS."""
    near = read_metadata(flight[1].read_bytes(), probe(flight[1].read_bytes())).gps
    return {"a.jpg": flight[0].read_bytes(), "b.jpg": retagged(elsewhere[0], gps=near)}


def two_continents(flight: list[Path], elsewhere: list[Path]) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in flight[:5]} | {
        f"s{p.name}": p.read_bytes() for p in elsewhere[:3]
    }


Case = Callable[[list[Path], list[Path]], dict[str, bytes]]


@pytest.mark.parametrize(
    ("photos", "sources", "said"),
    [
        (no_gps, {"vision-only": 6}, "no photo has usable GPS"),
        (one_picture, {"visual": 4}, ""),
        (one_photo, {"gnss": 1}, ""),
        (two_strangers, {"gnss": 2}, "2 of 2 photos tie to no other"),
        (two_continents, {"visual": 5}, "in a mission of its own|into a mission of its own"),
    ],
)
def test_odd_missions_end_with_a_map_and_say_what_it_is_worth(
    flight: list[Path],
    elsewhere: list[Path],
    server: str,
    tmp_path: Path,
    photos: Case,
    sources: dict[str, int],
    said: str,
) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    for name, data in photos(flight, elsewhere).items():
        (folder / name).write_bytes(data)
    done = orthostream("run", folder, "--out", tmp_path / "out", "--server", server)
    assert done.returncode == 0, done.stdout + done.stderr
    report, placed = results(tmp_path / "out")
    found = [f["source"] for f in placed.values()]
    assert {source: found.count(source) for source in found} == sources
    assert report["counts"]["fused"] == sum(sources.values())
    assert re.search(said, done.stdout)
    assert (tmp_path / "out" / "mosaic.tif").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("run", "nowhere", "--out", "out"), "no folder nowhere"),
        (("run", "empty", "--out", "out"), "Copy the JPEG or TIFF files"),
        (("run", "photos", "--out", "file"), "Choose another --out"),
        (("run", "photos", "--out", "out", "--gcp", "file"), "first line is 'rubbish'"),
        (("run", "photos", "--out", "out", "--gcp", "nowhere.txt"), "nowhere.txt"),
        (("run", "photos", "--out", "out", "--server", "http://a:b:c"), "not the address of a server"),
        (("serve", "--data-dir", "data", "--port", "99999"), "port is 99999"),
        (("serve", "--data-dir", "data", "--port", "{taken}"), "Choose another --host or --port"),
        (("serve", "--data-dir", "file"), "file cannot be created"),
        (("simulate", "--out", "file/below", "--frames", "2"), "cannot write to file/below"),
    ],
)
def test_what_cannot_be_done_ends_with_exit_2_and_a_sentence(
    flight: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], said: str
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "photos").mkdir()
    shutil.copy(flight[0], tmp_path / "photos")
    (tmp_path / "file").write_text("rubbish\n")
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = str(taken.getsockname()[1])
        done = orthostream(*(a.replace("{taken}", port) for a in arguments))
    assert done.returncode == 2, done.stdout + done.stderr
    assert said in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_a_full_disk_or_an_absent_server_ends_a_run_soon(flight: list[Path], tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    shutil.copy(flight[0], photos)
    with socket.socket() as nobody:
        nobody.bind(("127.0.0.1", 0))  # taken, but nobody listens
        command = [*PROGRAM, "run", str(photos), "--out", str(tmp_path / "b"), "--server"]
        address = f"127.0.0.1:{nobody.getsockname()[1]}"
        absent = subprocess.Popen([*command, address], stderr=subprocess.PIPE, stdout=subprocess.DEVNULL)
        full = orthostream("run", photos, "--out", tmp_path / "a", ORTHOSTREAM_MIN_FREE_BYTES=str(10**15))
        said = absent.communicate(timeout=30)[1].decode()
    assert full.returncode == absent.returncode == 2
    assert "Free some space" in full.stderr
    assert (
        said
        == f"orthostream: The server http://{address} does not answer ([Errno 111] Connection refused).\n"
    )
    assert not (tmp_path / "a" / "mosaic.tif").exists()


def test_ctrl_c_while_it_loads_shows_no_traceback(flight: list[Path], tmp_path: Path) -> None:
    command = [*PROGRAM, "run", str(flight[0].parent), "--out", str(tmp_path / "out")]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    maps = Path(f"/proc/{process.pid}/maps")
    while "numpy" not in maps.read_text():
        assert process.poll() is None
        time.sleep(0.002)
    process.send_signal(signal.SIGINT)
    said = process.communicate(timeout=20)[0].decode()
    assert "Traceback" not in said
    assert process.returncode == 130


def test_results_of_the_run_before_are_no_photos(flight: list[Path], server: str, tmp_path: Path) -> None:
    for path in flight[:3]:
        shutil.copy(path, tmp_path)
    for _ in range(2):
        done = orthostream("run", tmp_path, "--out", tmp_path, "--server", server)
        assert done.returncode == 0, done.stdout + done.stderr
        assert results(tmp_path)[0]["frames"] == 3


@pytest.mark.parametrize(
    ("parts", "status", "code"),
    [
        ({}, 400, "bad_upload"),
        ({"data": {"photo": "text"}, "files": {"telemetry": (None, "{}")}}, 422, "no_photos"),
        ({"files": {"f" * 100_000: ("a.jpg", b"x")}}, 400, "bad_upload"),
        ({"files": {"files": ("a" * 100_000, b"x")}}, 400, "bad_upload"),
        ({"data": {"telemetry": "{"}, "files": {"files": ("a.jpg", b"x")}}, 422, "bad_telemetry"),
        ({"data": {"telemetry": "[" * 99_999}, "files": {"files": ("a.jpg", b"x")}}, 422, "bad_telemetry"),
        ({"files": {"files": ("a.jpg", b"x")}}, 415, "not_an_image"),
    ],
)
def test_the_api_answers_nonsense_with_a_problem(
    server: str, parts: dict[str, Any], status: int, code: str
) -> None:
    api = f"{server}/api/v1/missions"
    mission = httpx.post(api, json={"name": "nonsense"}).json()["id"]
    for mission_id, expected in ((mission, (status, code)), ("aaaaaaaaaa", (404, "mission_not_found"))):
        answer = httpx.post(f"{api}/{mission_id}/frames", timeout=30, **parts)
        assert (answer.status_code, answer.json()["code"]) == expected
        assert answer.headers["content-type"] == "application/problem+json"
        assert answer.json()["detail"].endswith(".")
