"""Missions, frames, tiles, exports over HTTP: what every client may rely on."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable

import numpy as np
import pytest
from fastapi.testclient import TestClient

from core.frame import FrameMeta, GpsFix
from core.geometry import Camera, Pose, World
from services.api.context import Services
from services.api.sweep import Sweep
from services.catalog import exports, frames, leases, missions, poses, surveys, tiles
from services.catalog.poses import Placed, PoseUpdate
from services.catalog.tiles import Render, TileBox

CAMERA = Camera(800, 600, 540.0, 399.5, 299.5)
WORLD = World(47.05, 8.31, 440.0)
KEY = (19, 274250, 184260)
DOWN = np.diag([1.0, -1.0, -1.0])


def mission_of(url: str) -> str:
    return url.rsplit("/", 1)[1]


def place(services: Services, mission_id: str, *names: str, source: str = "visual") -> None:
    """Frames 30 m apart eastwards, posed 60 m above the ground; their one tile is dirty."""
    with services.db.write() as tx:
        epoch = leases.acquire(tx, mission_id, "test", 60) or 0
        placed = []
        for i, name in enumerate(names):
            frame_id = f"{i:032x}"
            gps = GpsFix(47.05, 8.31 + i * 0.001, 500.0)
            meta = FrameMeta(800, 600, captured_s=100.0 - i, gps=gps, drone="North" if i % 2 else "South")
            frames.receive(tx, mission_id, frame_id, name, 1, "image/jpeg", 800, 600)
            frames.mark_ready(tx, mission_id, frame_id, meta)
            frames.mark_matched(tx, mission_id, frame_id)
            pose = Pose(DOWN, np.array([30.0 * i, 0.0, 60.0]), 0.0, source)  # type: ignore[arg-type]
            placed.append(Placed(frame_id, "one", pose, TileBox(*KEY, *KEY[1:])))
        change = PoseUpdate(placed=placed, dirty={KEY: 0}, cameras={"one": CAMERA}, world=WORLD, zoom=19)
        poses.save(tx, mission_id, epoch, change)


def publish(services: Services, mission_id: str, data: bytes | None) -> int:
    """One native tile with these bytes; without bytes it becomes empty."""
    with services.db.write() as tx:
        mission = missions.get(tx, mission_id)
        revision = mission.revision + 1
        render = Render(KEY, mission.generation)
        if data is not None:
            key = f"missions/{mission_id}/tiles/19/274250/184260/{revision}"
            services.store.put(key, data)
            render = Render(KEY, mission.generation, key, f"e{revision}", "image/jpeg", len(data))
        tiles.record_renders(tx, mission_id, [render])
        return tiles.publish(tx, mission_id, mission.revision, [render], [render])


def test_a_mission_is_created_listed_and_deleted(api: TestClient, services: Services) -> None:
    made = api.post("/api/v1/missions", json={"name": "  River\n bank ", "mode": "gnss", "max_side": 1600})
    assert made.status_code == 201
    mission = made.json()
    assert (mission["name"], mission["mode"], mission["max_side"]) == ("River bank", "gnss", 1600)
    assert mission["url"] == f"http://testserver/missions/{mission['id']}"
    url = made.headers["location"]
    assert api.get(url).json() == mission
    assert [m["id"] for m in api.get("/api/v1/missions").json()["missions"]] == [mission["id"]]
    services.store.put(f"missions/{mission['id']}/photos/{'a' * 32}", b"photo")
    assert api.delete(url).status_code == 204
    for gone in (url, f"{url}/progress", f"{url}/frames", f"{url}/tilejson.json", f"{url}/tiles/0/0/0"):
        answer = api.get(gone)
        assert (answer.status_code, answer.json()["code"]) == (404, "mission_not_found")
    assert api.get("/api/v1/missions").json()["missions"] == []


def test_the_sweep_removes_what_was_deleted_and_wakes_what_stood_still(
    api: TestClient, services: Services, sent, mission_url: str, jpeg: Callable[..., bytes]
) -> None:
    api.post(f"{mission_url}/frames", files=[("files", ("a.jpg", jpeg()))])
    other = api.post("/api/v1/missions", json={}).json()["id"]
    services.store.put(f"missions/{other}/photos/{'a' * 32}", b"photo")
    api.delete(f"/api/v1/missions/{other}")
    pieces = services.settings.exports_dir / f"{other}-mosaic.tif.0"  # of a worker that was killed
    pieces.mkdir(parents=True)
    (pieces / "0-0.drawn").touch()
    sent.tasks.clear()
    settings = services.settings.model_copy(update={"stalled_after_s": 0.0})
    time.sleep(0.01)
    Sweep(settings, services.db, services.store, sent, services.uploads).once()
    assert sent.tasks == [
        ("ingest", mission_of(mission_url), *[t.name for t in _photos(services, mission_url)])
    ]
    assert not list(services.store.list(f"missions/{other}/"))
    assert not pieces.exists()
    with services.db.read() as tx:
        assert missions.deleting(tx) == []


def _photos(services: Services, url: str):
    folder = services.store.root / "missions" / mission_of(url) / "photos"  # type: ignore[attr-defined]
    return sorted(folder.iterdir())


def test_lists_come_in_pages_without_gap_or_repeat(
    api: TestClient, services: Services, mission_url: str
) -> None:
    with services.db.write() as tx:
        for i in range(7):
            frames.receive(
                tx, mission_of(mission_url), f"{i:032x}", f"{i}.jpg", 1, "image/jpeg", 9, 9, now=1.0
            )
            missions.create(tx, f"m{i}", now=2.0)
    seen: list[str] = []
    after = ""
    while True:
        page = api.get(f"{mission_url}/frames?limit=3{after}").json()
        seen += [f["name"] for f in page["frames"]]
        if page["next"] is None:
            break
        after = f"&after={page['next']}"
    assert seen == [f"{i}.jpg" for i in range(7)]
    first = api.get("/api/v1/missions?limit=5").json()
    rest = api.get(f"/api/v1/missions?limit=5&after={first['next']}").json()
    assert len({m["id"] for m in first["missions"] + rest["missions"]}) == 8
    assert rest["next"] is None


def test_what_is_known_of_the_scale_is_kept_and_can_be_changed(
    api: TestClient, services: Services, sent
) -> None:
    marker = {"photo": "a.jpg", "pixels": [[10.0, 20.0], [40.0, 60.0]], "length_m": 2.5}
    asked = {"first_height_m": 60.0, "marker": None}
    made = api.post("/api/v1/missions", json={"scale": {"first_height_m": 60}}).json()
    url = f"/api/v1/missions/{made['id']}"
    assert (made["scale"], made["georeferenced"]) == (asked, None)
    changed = api.put(f"{url}/scale", json={"marker": marker})
    assert changed.json()["scale"] == {"first_height_m": None, "marker": marker}
    assert sent.tasks == []  # no photo was placed by it yet
    place(services, made["id"], "a.jpg", source="vision-only")
    report = api.get(f"{url}/report").json()
    assert report["scale"] == {"first_height_m": None, "marker": marker, "used": True}
    assert (report["georeferenced"], api.get(url).json()["georeferenced"]) == (False, False)
    assert api.put(f"{url}/scale", json={}).json()["scale"] is None
    assert sent.tasks == [("sequence", made["id"])]
    for wrong in ({"first_height_m": 0}, {"first_height_m": 9, "marker": marker}, {"marker": {"photo": "a"}}):
        assert api.put(f"{url}/scale", json=wrong).status_code == 422
        assert api.post("/api/v1/missions", json={"scale": wrong}).status_code == 422
    same = {"marker": marker | {"pixels": [[1, 1], [1, 1]]}}
    assert api.put(f"{url}/scale", json=same).json()["code"] == "bad_scale"


def test_the_live_report_says_how_far_surveyed_points_lie_off(
    api: TestClient, services: Services, mission_url: str
) -> None:
    mission_id = mission_of(mission_url)
    place(services, mission_id, "a.jpg", "b.jpg")
    rows = ["8.31 47.05 440 399.5 299.5 a.jpg P1", "8.31 47.05 440 9 9 gone.jpg P2"]
    api.put(f"{mission_url}/checkpoints", content="\n".join(["EPSG:4326", *rows]))
    told = api.get(f"{mission_url}/report").json()
    assert told["checkpoints"]["poses"]["raw_m"] == pytest.approx(0.0, abs=1e-3)  # right below the camera
    assert [(p["point"], p["unseen"]) for p in told["checkpoints"]["points"]] == [
        ("P1", None), ("P2", "no_photo"),
    ]  # fmt: skip
    assert (told["checkpoints"]["mosaic"], told["checkpoints_revision"]) == (None, None)
    found = {"revision": 4, "generation": 1, "mosaic": {"points": 2, "found": 1, "raw_m": 0.5}, "points": {}}
    with services.db.write() as tx:
        content = surveys.get(tx, mission_id).content  # type: ignore[union-attr]
        surveys.keep_measured(tx, mission_id, "other points", {"revision": 9})
        surveys.keep_measured(tx, mission_id, content, found)
    told = api.get(f"{mission_url}/report").json()
    assert (told["checkpoints"]["mosaic"], told["checkpoints_revision"]) == (found["mosaic"], 4)
    api.delete(f"{mission_url}/checkpoints")
    assert "checkpoints" not in api.get(f"{mission_url}/report").json()


def test_finalise_wakes_the_sequencer_once_asked(api: TestClient, mission_url: str, sent) -> None:
    answer = api.post(f"{mission_url}/finalise")
    assert (answer.status_code, answer.json()["state"]) == (202, "finalising")
    assert sent.tasks == [("sequence", mission_of(mission_url))]


def test_a_tile_is_sent_as_stored_and_checked_by_its_etag(
    api: TestClient, services: Services, mission_url: str
) -> None:
    url = f"{mission_url}/tiles/19/274250/184260"
    nothing = api.get(url)
    assert (nothing.status_code, nothing.content) == (204, b"")
    place(services, mission_of(mission_url), "a.jpg")
    publish(services, mission_of(mission_url), b"first")
    tile = api.get(url)
    assert (tile.status_code, tile.content, tile.headers["content-type"]) == (200, b"first", "image/jpeg")
    assert tile.headers["cache-control"] == "no-cache"
    etag = tile.headers["etag"]
    for offered in (etag, f"W/{etag}", f'"x", {etag}', "*"):
        same = api.get(url, headers={"if-none-match": offered})
        assert (same.status_code, same.content, same.headers["etag"]) == (304, b"", etag)
    publish(services, mission_of(mission_url), b"second")
    assert api.get(url, headers={"if-none-match": etag}).content == b"second"


def test_a_revision_never_changes(api: TestClient, services: Services, mission_url: str) -> None:
    place(services, mission_of(mission_url), "a.jpg")
    for data in (b"one", b"two", None):
        publish(services, mission_of(mission_url), data)

    def at(revision: int):
        return api.get(f"{mission_url}/revisions/{revision}/tiles/19/274250/184260")

    assert [(at(r).status_code, at(r).content) for r in range(4)] == [
        (204, b""),
        (200, b"one"),
        (200, b"two"),
        (204, b""),
    ]
    assert all("immutable" in at(r).headers["cache-control"] for r in range(4))
    future = at(4)
    assert (future.status_code, future.json()["code"]) == (404, "revision_not_found")
    assert "immutable" not in future.headers.get("cache-control", "")


def test_tilejson_frames_the_map(api: TestClient, services: Services, mission_url: str) -> None:
    before = api.get(f"{mission_url}/tilejson.json").json()
    assert "bounds" not in before
    place(services, mission_of(mission_url), "a.jpg")
    publish(services, mission_of(mission_url), b"tile")
    known = api.get(f"{mission_url}/tilejson.json").json()
    assert (known["tilejson"], known["tileSize"], known["maxzoom"]) == ("3.0.0", 512, 19)
    assert known["tiles"] == [f"http://testserver{mission_url}/tiles/{{z}}/{{x}}/{{y}}"]
    west, south, east, north = known["bounds"]
    assert west == pytest.approx(274250 / 2**19 * 360 - 180)
    assert east - west == pytest.approx(360 / 2**19)
    assert 47.06 < south < north < 47.07


def test_footprints_lie_under_their_cameras(api: TestClient, services: Services, mission_url: str) -> None:
    place(services, mission_of(mission_url), "a.jpg", "b.jpg", "c.jpg", source="gnss")
    answer = api.get(f"{mission_url}/frames.geojson")
    assert answer.headers["content-type"] == "application/geo+json"
    features = answer.json()["features"]
    kinds = [f["properties"]["kind"] for f in features]
    assert (kinds.count("footprint"), kinds.count("camera"), kinds.count("track")) == (3, 3, 1)
    footprint = next(
        f for f in features if f["properties"].get("name") == "b.jpg" and f["geometry"]["type"] == "Polygon"
    )
    assert footprint["properties"] | {"state": "posed", "source": "gnss"} == footprint["properties"]
    (ring,) = footprint["geometry"]["coordinates"]
    assert ring[0] == ring[-1]
    metres = WORLD.from_geodetic(np.array([[*p, 440.0] for p in ring[:4]]))
    half_w, half_h = 399.5 / 540 * 60, 299.5 / 540 * 60
    expected = [[30 - half_w, half_h], [30 + half_w, half_h], [30 + half_w, -half_h], [30 - half_w, -half_h]]
    assert metres[:, :2] == pytest.approx(np.array(expected), abs=0.05)
    # Later photos first in the list: the track goes by the time of capture, not of arrival.
    track = next(f for f in features if f["properties"]["kind"] == "track")
    assert track["geometry"]["coordinates"][0][0] > track["geometry"]["coordinates"][1][0]
    heads = [f["properties"]["name"] for f in features if f["properties"].get("head")]
    assert sorted(heads) == ["a.jpg", "b.jpg"]
    again = api.get(f"{mission_url}/frames.geojson", headers={"if-none-match": answer.headers["etag"]})
    assert again.status_code == 304


def test_photos_that_are_only_located_by_gps_are_on_the_track_too(
    api: TestClient, services: Services, mission_url: str
) -> None:
    with services.db.write() as tx:
        for i, gps in enumerate((GpsFix(47.05, 8.31), None)):
            frames.receive(tx, mission_of(mission_url), f"{i:032x}", f"{i}.jpg", 1, "image/jpeg", 9, 9)
            frames.mark_ready(tx, mission_of(mission_url), f"{i:032x}", FrameMeta(9, 9, gps=gps))
    (camera,) = api.get(f"{mission_url}/frames.geojson").json()["features"]
    assert camera["geometry"]["coordinates"] == [8.31, 47.05]
    assert camera["properties"]["state"] == "ready"


def test_the_report_adds_up(api: TestClient, services: Services, mission_url: str) -> None:
    place(services, mission_of(mission_url), "a.jpg", "b.jpg")
    publish(services, mission_of(mission_url), b"tile")
    api.post(f"{mission_url}/frames", files=[("files", ("notes.txt", b"hello"))])
    known = api.get(f"{mission_url}/report").json()
    assert known["frames"] == 3
    assert {state: n for state, n in known["counts"].items() if n} == {"fused": 2, "rejected": 1}
    (rejected,) = known["rejected"]
    assert (rejected["name"], rejected["code"]) == ("notes.txt", "not_an_image")
    assert 0 <= known["latency_s"]["p50"] <= known["latency_s"]["p95"]
    progress = api.get(f"{mission_url}/progress").json()
    assert (progress["total"], progress["revision"], progress["idle"]) == (3, 1, True)
    assert progress["latency_s"] == known["latency_s"]


def test_an_export_is_made_once_asked_for_and_streamed_in_parts(
    api: TestClient, services: Services, mission_url: str, sent
) -> None:
    mission_id = mission_of(mission_url)
    assert {e["state"] for e in api.get(f"{mission_url}/exports").json()["exports"]} == {"available"}
    url = f"{mission_url}/exports/mosaic.tif"
    for _ in range(2):
        wanted = api.get(url)
        assert (wanted.status_code, wanted.json()["state"]) == (202, "wanted")
        assert int(wanted.headers["retry-after"]) >= 1
    assert sent.tasks == [("export", mission_id, "mosaic.tif")]
    data = bytes(range(256)) * 10_000
    services.store.put(f"missions/{mission_id}/exports/0/mosaic.tif", data)
    with services.db.write() as tx:
        exports.finish(
            tx,
            mission_id,
            "mosaic.tif",
            0,
            f"missions/{mission_id}/exports/0/mosaic.tif",
            len(data),
            "image/tiff",
        )
    whole = api.get(url)
    assert (whole.status_code, whole.content, whole.headers["content-type"]) == (200, data, "image/tiff")
    assert "mosaic.tif" in whole.headers["content-disposition"]
    head = api.head(url)
    assert (head.status_code, head.headers["content-length"], head.content) == (200, str(len(data)), b"")
    for asked, part in (
        ("0-9", data[:10]),
        ("100-", data[100:]),
        ("-5", data[-5:]),
        ("5-99999999", data[5:]),
    ):
        answer = api.get(url, headers={"range": f"bytes={asked}"})
        assert (answer.status_code, answer.content) == (206, part)
        assert answer.headers["content-range"].endswith(f"/{len(data)}")
    assert api.get(url, headers={"range": "bytes=99999999-"}).status_code == 416
    assert api.get(url, headers={"range": "bytes=0-1,4-5"}).content == data


def test_a_failed_export_says_so_until_somebody_tries_again(
    api: TestClient, services: Services, mission_url: str, sent
) -> None:
    url = f"{mission_url}/exports/poses.json"
    api.get(url)
    with services.db.write() as tx:
        exports.fail(tx, mission_of(mission_url), "poses.json", 0, "No photo could be placed.")
    failed = api.get(url)
    assert (failed.status_code, failed.json()["code"]) == (409, "export_failed")
    assert failed.json()["detail"] == "No photo could be placed."
    assert len(sent.tasks) == 1
    assert api.get(f"{url}?retry=true").status_code == 202
    assert len(sent.tasks) == 2


@pytest.mark.parametrize(
    ("method", "path", "status"),
    [
        ("GET", "/api/v1/nothing", 404),
        ("GET", "/api/v1/missions/..%2f..%2fetc", 404),
        ("GET", "/api/v1/missions/%00", 404),
        ("GET", "/api/v1/missions?limit=0", 422),
        ("GET", "/api/v1/missions?after=unknown", 404),
        ("PUT", "/api/v1/missions", 405),
        ("GET", "/assets/none.js", 404),
    ],
)
def test_every_refusal_is_a_problem(api: TestClient, method: str, path: str, status: int) -> None:
    answer = api.request(method, path)
    assert answer.status_code == status
    assert answer.headers["content-type"] == "application/problem+json"
    assert {"title", "status", "code", "detail"} <= answer.json().keys()


@pytest.mark.parametrize(
    "body", [{"name": ""}, {"name": "\n\t"}, {"name": "x" * 121}, {"mode": "lidar"}, {"max_side": 10}, []]
)
def test_a_mission_needs_sensible_values(api: TestClient, body: object) -> None:
    answer = api.post("/api/v1/missions", json=body)
    assert (answer.status_code, answer.json()["code"]) == (422, "invalid_request")


def test_an_error_nobody_thought_of_is_a_problem_without_secrets(
    api: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object) -> None:
        raise RuntimeError("password=hunter2")

    monkeypatch.setattr(missions, "get", broken)
    answer = api.get("/api/v1/missions/abc")
    assert (answer.status_code, answer.json()["code"]) == (500, "internal_error")
    assert "hunter2" not in answer.text


def test_health_and_readiness(api: TestClient, services: Services) -> None:
    assert api.get("/health").json() == {"status": "ok"}
    assert api.get("/ready").json() == {"ready": True, "checks": {"database": "ok", "uploads": "ok"}}
    services.uploads.rmdir()
    answer = api.get("/ready")
    assert (answer.status_code, answer.json()["ready"]) == (503, False)


def test_the_api_needs_neither_opencv_nor_gtsam() -> None:
    program = "import sys, services.api.app; print(*sys.modules, sep='\\n')"
    loaded = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    ).stdout.split()
    assert "fastapi" in loaded
    assert not {"cv2", "gtsam", "scipy", "numba", "rasterio", "workers"} & set(loaded)
