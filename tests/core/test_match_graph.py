"""Features, candidates and matches together, on flights whose truth is known and on real ones if there."""

from __future__ import annotations

import hashlib
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from core.decode import decode_rgb
from core.features import Features, extract
from core.geometry import Camera
from core.matching import PairMatch, match_pair
from core.metadata import read_metadata
from core.neighbours import Sighting, candidates
from core.photo import PhotoLimits, probe
from core.photography import GroundPicture, develop, expose
from core.simulation import Flight, FlightParams, Shot, plan_flight

FLIGHTS = Path(__file__).parents[3] / "shared" / "data"
REAL = [name for name in ("brighton_beach",) if (FLIGHTS / name / "images").is_dir()]

HARD = {
    "low overlap": FlightParams(
        frames=16, drones=1, forward_overlap=0.4, side_overlap=0.3, width_px=640, height_px=480, seed=4
    ),
    "hills of 30 m": FlightParams(frames=12, drones=1, relief_m=30, width_px=640, height_px=480, seed=5),
    "tilted, with cars": FlightParams(
        frames=10, drones=1, tilt_deg=6, cars=80, k1=-0.05, width_px=640, height_px=480, seed=6
    ),
}


def components(ids: list[str], pairs: list[tuple[str, str]]) -> list[int]:
    group = {i: {i} for i in ids}
    for a, b in pairs:
        if group[a] is not group[b]:
            group[a] |= group[b]
            for i in group[b]:
                group[i] = group[a]
    return sorted((len(g) for g in {id(g): g for g in group.values()}.values()), reverse=True)


def shared(flight: Flight, a: Shot, b: Shot) -> float:
    """Share of a's picture that b shows too."""
    u, v = np.meshgrid(np.linspace(0, a.camera.width - 1, 16), np.linspace(0, a.camera.height - 1, 12))
    seen = b.pose.pixels(b.camera, flight.ground(a, np.column_stack((u.ravel(), v.ravel()))))
    return float(((seen > 0) & (seen < (b.camera.width - 1, b.camera.height - 1))).all(1).mean())


def errors_px(flight: Flight, a: Shot, b: Shot, match: PairMatch) -> np.ndarray:
    truth = b.pose.pixels(b.camera, flight.ground(a, match.uv_low.astype(float)))
    return np.asarray(np.linalg.norm(truth - match.uv_high, axis=1))


@pytest.mark.parametrize("name", HARD)
def test_no_false_pair_and_no_good_one_missed(name: str, tmp_path: Path) -> None:
    flight = plan_flight(HARD[name])
    picture = GroundPicture.create(tmp_path, flight)
    by_id: dict[str, tuple[Shot, Features]] = {}
    for shot in flight.shots:
        rgb = develop(flight, shot, expose(picture, shot))
        size = (shot.camera.width, shot.camera.height)
        by_id[hashlib.sha256(rgb.tobytes()).hexdigest()[:32]] = (shot, extract(rgb, size))
    accepted, wrong = [], list[float]()
    for low, high in combinations(sorted(by_id), 2):
        (a, fa), (b, fb) = by_id[low], by_id[high]
        match = match_pair(low, fa, high, fb, a.camera, b.camera)
        if match.accepted:
            accepted.append((low, high))
            errors = errors_px(flight, a, b, match)
            assert np.median(errors) < 1
            assert (errors > 4).mean() < 0.1
            wrong += (errors > 4).tolist()
        else:
            assert shared(flight, a, b) < 0.35
    assert np.mean(wrong) < 0.005
    assert components(sorted(by_id), accepted) == [len(by_id)]


@pytest.mark.parametrize("name", REAL)
@pytest.mark.parametrize("knowing", ["gps and time", "looks alone"])
def test_all_frames_of_a_real_flight_hang_together(name: str, knowing: str) -> None:
    frames: dict[str, tuple[Sighting, Features, Camera]] = {}
    for path in sorted((FLIGHTS / name / "images").iterdir()):
        data = path.read_bytes()
        meta = read_metadata(data, probe(data, PhotoLimits()), None)
        features = extract(decode_rgb(data, 1600), (meta.width, meta.height))
        frame_id = hashlib.sha256(data).hexdigest()[:32]
        sighting = Sighting(frame_id, meta.captured_s, path.name, meta.drone, meta.gps, features.words)
        if knowing == "looks alone":
            sighting = Sighting(frame_id, None, frame_id, frame_id, None, features.words)
        frames[frame_id] = (sighting, features, meta.camera())
    proposed = candidates([s for s, _, _ in frames.values()])
    accepted = []
    for low, high in proposed:
        (_, fa, ca), (_, fb, cb) = frames[low], frames[high]
        if match_pair(low, fa, high, fb, ca, cb).accepted:
            accepted.append((low, high))
    assert len(proposed) <= 12 * len(frames)
    assert components(sorted(frames), accepted) == [len(frames)]
