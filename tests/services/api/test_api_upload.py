"""Uploads: durable before they are confirmed, idempotent, refused with a reason, nothing left lying about."""

from __future__ import annotations

import hashlib
import json
import struct
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from fastapi.testclient import TestClient
from hypothesis import given
from hypothesis import strategies as st

from services.api.context import Services
from services.api.multipart import FormReader, clean_name
from services.api.problems import BadUpload
from services.catalog import frames
from services.errors import OutOfDisk

Jpeg = Callable[..., bytes]


def frame_id(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:32]


def send(api: TestClient, url: str, *photos: tuple[str, bytes], **more: object):
    return api.post(f"{url}/frames", files=[("files", photo) for photo in photos], **more)  # type: ignore[arg-type]


def huge_tiff(side: int) -> bytes:
    """A TIFF header that promises side × side pixels and holds none."""
    tags = [(256, side), (257, side), (258, 8), (259, 1), (262, 1), (277, 1)]
    entries = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags)
    return b"II*\x00" + struct.pack("<IH", 8, len(tags)) + entries + b"\0\0\0\0"


def test_a_new_photo_is_kept_and_a_worker_woken(
    api: TestClient, services: Services, mission_url: str, jpeg: Jpeg, sent
) -> None:
    photo = jpeg()
    answer = send(api, mission_url, ("DJI_0001.JPG", photo))
    assert answer.status_code == 201
    assert answer.json() == {
        "frames": [
            {"name": "DJI_0001.JPG", "frame_id": frame_id(photo), "state": "received", "created": True}
        ]
    }
    mission_id = mission_url.rsplit("/", 1)[1]
    assert services.store.get(f"missions/{mission_id}/photos/{frame_id(photo)}") == photo
    assert sent.tasks == [("ingest", mission_id, frame_id(photo))]
    (listed,) = api.get(f"{mission_url}/frames").json()["frames"]
    assert (listed["width"], listed["height"], listed["size_bytes"]) == (160, 120, len(photo))
    assert not list(services.uploads.iterdir())


def test_the_same_photo_again_is_the_same_frame(api: TestClient, mission_url: str, jpeg: Jpeg, sent) -> None:
    send(api, mission_url, ("a.jpg", jpeg()))
    again = send(api, mission_url, ("renamed.jpg", jpeg()))
    assert again.status_code == 200
    assert again.json()["frames"][0]["created"] is False
    assert len(api.get(f"{mission_url}/frames").json()["frames"]) == 1
    assert len(sent.tasks) == 1


def test_a_photo_that_failed_for_our_reasons_has_another_try(
    api: TestClient, services: Services, mission_url: str, jpeg: Jpeg, sent
) -> None:
    mission_id = mission_url.rsplit("/", 1)[1]
    send(api, mission_url, ("a.jpg", jpeg()))
    with services.db.write() as tx:
        frames.mark_rejected(tx, mission_id, frame_id(jpeg()), "internal", "The reader broke down.")
    services.store.delete(f"missions/{mission_id}/photos/{frame_id(jpeg())}")
    again = send(api, mission_url, ("a.jpg", jpeg()))
    assert again.status_code == 200
    (told,) = again.json()["frames"]
    assert (told["state"], told["created"], "code" in told) == ("received", False, False)
    assert sent.tasks == [("ingest", mission_id, frame_id(jpeg()))] * 2
    assert services.store.get(f"missions/{mission_id}/photos/{frame_id(jpeg())}") == jpeg()


def test_many_photos_one_result_each_in_order(api: TestClient, mission_url: str, jpeg: Jpeg) -> None:
    photos = [(f"{i}.jpg", jpeg(i)) for i in range(20)]
    photos[7] = ("notes.txt", b"no photo at all")
    answer = send(api, mission_url, *photos)
    assert answer.status_code == 201
    results = answer.json()["frames"]
    assert [r["name"] for r in results] == [name for name, _ in photos]
    assert [r["frame_id"] for r in results] == [frame_id(data) for _, data in photos]
    assert [r["state"] for r in results] == ["received"] * 7 + ["rejected"] + ["received"] * 12
    assert results[7]["code"] == "not_an_image"
    assert "JPEG" in results[7]["detail"]


@pytest.mark.parametrize(
    ("name", "make", "status", "code"),
    [
        ("empty.jpg", lambda jpeg: b"", 422, "empty_file"),
        ("text.jpg", lambda jpeg: b"hello", 415, "not_an_image"),
        ("picture.png", lambda jpeg: b"\x89PNG\r\n\x1a\n" + bytes(100), 415, "not_an_image"),
        ("torn.jpg", lambda jpeg: jpeg()[:30], 422, "truncated_image"),
        ("large.jpg", lambda jpeg: jpeg() + bytes(1_000_000), 413, "file_too_large"),
        ("vast.tif", lambda jpeg: huge_tiff(20_000), 413, "too_many_pixels"),
        ("thumb.jpg", lambda jpeg: jpeg(0, 32, 32), 422, "too_few_pixels"),
    ],
)
def test_a_refused_photo_says_why_and_is_counted(
    api: TestClient, services: Services, mission_url: str, jpeg: Jpeg, sent, name, make, status, code
) -> None:
    data = make(jpeg)
    answer = send(api, mission_url, (name, data))
    assert answer.status_code == status
    assert answer.headers["content-type"] == "application/problem+json"
    problem = answer.json()
    assert problem["code"] == code
    assert problem["errors"] == [
        {"name": name, "frame_id": frame_id(data), "state": "rejected", "created": False, "code": code,
         "detail": problem["detail"]}
    ]  # fmt: skip
    (frame,) = api.get(f"{mission_url}/frames?state=rejected").json()["frames"]
    assert (frame["name"], frame["code"], frame["reason"]) == (name, code, problem["detail"])
    assert api.get(f"{mission_url}/progress").json()["counts"]["rejected"] == 1
    assert sent.tasks == []
    assert not list(services.store.list("missions/"))
    assert not list(services.uploads.iterdir())


def test_when_all_are_refused_for_different_reasons_each_is_listed(
    api: TestClient, mission_url: str, jpeg: Jpeg
) -> None:
    answer = send(api, mission_url, ("a.txt", b"hello"), ("b.jpg", b""))
    assert (answer.status_code, answer.json()["code"]) == (415, "all_refused")
    assert [e["code"] for e in answer.json()["errors"]] == ["not_an_image", "empty_file"]


def test_telemetry_goes_with_its_photo(
    api: TestClient, services: Services, mission_url: str, jpeg: Jpeg
) -> None:
    said = json.dumps({"b.jpg": {"lat": 47.1, "lon": 8.2, "yaw": 90}})
    photos = [("files", ("a.jpg", jpeg(1))), ("files", ("b.jpg", jpeg(2)))]
    assert api.post(f"{mission_url}/frames", data={"telemetry": said}, files=photos).status_code == 201
    with services.db.read() as tx:
        known = {f.name: f.telemetry for f in frames.list(tx, mission_url.rsplit("/", 1)[1])}
    assert known == {"a.jpg": None, "b.jpg": {"lat": 47.1, "lon": 8.2, "yaw": 90.0}}


@pytest.mark.parametrize(
    "said", ["{", "[]", '{"a.jpg": 7}', '{"a.jpg": {"lat": 1e9}}', '{"a.jpg": {"lat": NaN}}', "[" * 100_000]
)
def test_bad_telemetry_is_refused(api: TestClient, mission_url: str, jpeg: Jpeg, said: str) -> None:
    answer = api.post(f"{mission_url}/frames", data={"telemetry": said}, files=[("files", ("a.jpg", jpeg()))])
    assert (answer.status_code, answer.json()["code"]) == (422, "bad_telemetry")
    assert api.get(f"{mission_url}/frames").json()["frames"] == []


def test_telemetry_behind_the_photos_is_refused(api: TestClient, mission_url: str, jpeg: Jpeg) -> None:
    parts = [("files", ("a.jpg", jpeg(), "image/jpeg")), ("telemetry", (None, "{}"))]
    answer = api.post(f"{mission_url}/frames", files=parts)
    assert (answer.status_code, answer.json()["code"]) == (422, "bad_telemetry")


@pytest.mark.parametrize(
    ("content_type", "body", "status"),
    [
        ("text/plain", b"hello", 400),
        ("multipart/form-data", b"hello", 400),
        ("multipart/form-data; boundary=x", b"", 400),
        ("multipart/form-data; boundary=x", b"--x\r\nContent-Dispo", 400),
        ("multipart/form-data; boundary=x", b"--x--\r\n", 422),
        ("multipart/form-data; boundary=" + "x" * 300, b"--x--\r\n", 400),
    ],
)
def test_what_is_no_upload_is_refused(
    api: TestClient, mission_url: str, content_type: str, body: bytes, status: int
) -> None:
    answer = api.post(f"{mission_url}/frames", content=body, headers={"content-type": content_type})
    assert (answer.status_code, answer.headers["content-type"]) == (status, "application/problem+json")


def test_a_torn_request_keeps_the_photos_that_came_whole(
    api: TestClient, services: Services, mission_url: str, jpeg: Jpeg
) -> None:
    part = b'--x\r\nContent-Disposition: form-data; name="files"; filename="%s"\r\n\r\n%s'
    body = part % (b"a.jpg", jpeg(1)) + b"\r\n" + part % (b"b.jpg", jpeg(2)[:500])
    answer = api.post(
        f"{mission_url}/frames", content=body, headers={"content-type": "multipart/form-data; boundary=x"}
    )
    assert (answer.status_code, answer.json()["code"]) == (400, "bad_upload")
    assert [f["name"] for f in api.get(f"{mission_url}/frames").json()["frames"]] == ["a.jpg"]
    assert not list(services.uploads.iterdir())


def test_an_unknown_mission_takes_nothing(api: TestClient, jpeg: Jpeg) -> None:
    assert send(api, "/api/v1/missions/nowhere", ("a.jpg", jpeg())).status_code == 404


def test_a_full_disk_says_so_and_keeps_the_rest(
    api: TestClient, services: Services, mission_url: str, jpeg: Jpeg, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OutOfDisk

    monkeypatch.setattr(type(services.store), "put_file", full)
    answer = send(api, mission_url, ("a.jpg", jpeg()))
    assert (answer.status_code, answer.json()["code"]) == (507, "out_of_disk")
    # The photo is good: it must be accepted as new when there is room again.
    assert api.get(f"{mission_url}/frames").json()["frames"] == []
    monkeypatch.undo()
    assert send(api, mission_url, ("a.jpg", jpeg())).status_code == 201


def test_parallel_uploads_of_one_photo_make_one_frame(
    api: TestClient, mission_url: str, jpeg: Jpeg, sent
) -> None:
    photos = [jpeg(i) for i in range(4)]
    with ThreadPoolExecutor(8) as pool:
        answers = list(pool.map(lambda i: send(api, mission_url, ("a.jpg", photos[i % 4])), range(24)))
    assert sorted(a.status_code for a in answers) == [200] * 20 + [201] * 4
    assert len(sent.tasks) == 4


def test_a_photo_reopens_a_final_mission(
    api: TestClient, services: Services, mission_url: str, jpeg: Jpeg
) -> None:
    from services.catalog import leases, missions

    mission_id = mission_url.rsplit("/", 1)[1]
    api.post(f"{mission_url}/finalise")
    with services.db.write() as tx:
        assert missions.finish(tx, mission_id, leases.acquire(tx, mission_id, "test", 60) or 0)
    assert api.get(mission_url).json()["state"] == "final"
    send(api, mission_url, ("late.jpg", jpeg()))
    assert api.get(mission_url).json()["state"] == "open"


@given(st.text(max_size=400))
def test_a_clean_name_is_a_plain_short_name(raw: str) -> None:
    name = clean_name(raw)
    assert name
    assert len(name) <= 200
    assert name.isprintable()
    assert "/" not in name
    assert "\\" not in name
    assert clean_name(name) == name


@pytest.mark.parametrize(
    ("raw", "name"),
    [
        ("../../etc/passwd", "passwd"),
        ("C:\\DCIM\\DJI_0001.JPG", "DJI_0001.JPG"),
        ("a\x00b\n.jpg", "ab.jpg"),
        ("", "photo"),
        ("x" * 300 + ".jpeg", "x" * 195 + ".jpeg"),
        ("Übersicht (1).tif", "Übersicht (1).tif"),
    ],
)
def test_names_as_people_send_them(raw: str, name: str) -> None:
    assert clean_name(raw) == name


@given(
    st.lists(st.binary(max_size=300), min_size=1, max_size=4),
    st.integers(1, 97),
)
def test_the_reader_finds_every_byte_however_the_body_is_cut(
    tmp_path_factory, photos: list[bytes], step: int
) -> None:
    folder = Path(tmp_path_factory.getbasetemp())
    boundary = "0" * 40
    body = b"".join(
        b'--%s\r\nContent-Disposition: form-data; name="files"; filename="%d.jpg"\r\n\r\n%s\r\n'
        % (boundary.encode(), i, data)
        for i, data in enumerate(photos)
    ) + f"--{boundary}--\r\n".encode()  # fmt: skip
    reader = FormReader(f"multipart/form-data; boundary={boundary}", folder, 200)
    for i in range(0, len(body), step):
        reader.feed([body[i : i + step]])
    reader.end()
    assert [f.frame_id for f in reader.finished] == [frame_id(data) for data in photos]
    assert [f.size_bytes for f in reader.finished] == [len(data) for data in photos]
    for file, data in zip(reader.finished, photos, strict=True):
        assert (file.path.read_bytes() == data) if file.path else len(data) > 200
    left = [f.path for f in reader.finished if f.path]
    reader.close()
    assert not any(path.exists() for path in left)


@given(st.binary(max_size=400))
def test_the_reader_refuses_garbage_in_one_way_only(tmp_path_factory, body: bytes) -> None:
    reader = FormReader("multipart/form-data; boundary=x", Path(tmp_path_factory.getbasetemp()), 200)
    try:
        reader.feed([body])
        reader.end()
    except BadUpload:
        pass
    finally:
        reader.close()
