"""The live map in a real browser: tiles arrive while one watches, and all around the map tells the truth."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Browser, Page, expect

from core.errors import TruncatedImage
from services.catalog import exports, frames, missions
from services.catalog.poses import PoseUpdate

if TYPE_CHECKING:
    from conftest import Mission, Service, Shot

ROOT = Path(__file__).resolve().parents[2]
SHOTS = ROOT / "out" / "page"
BACKGROUND = np.array([0x14, 0x18, 0x1A])
TILE = re.compile(r"/tiles/(\d+)/(\d+)/(\d+)$")


@pytest.fixture
def page(browser: Browser, service: Service) -> Iterator[Page]:
    """A page that must not complain, and must not talk to anybody but our service."""
    context = browser.new_context(viewport={"width": 1360, "height": 820}, accept_downloads=True)
    page = context.new_page()
    complaints: list[str] = []
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("console", lambda said: said.type == "error" and complaints.append(said.text))
    ours = (service.url, "blob:", "data:")
    page.on("request", lambda request: request.url.startswith(ours) or complaints.append(request.url))
    yield page
    context.close()
    # What the service refuses, or cannot answer because it is gone, the page itself tells.
    assert [c for c in complaints if "Failed to load resource" not in c] == []


def picture(page: Page, name: str) -> np.ndarray:
    """A screenshot, kept for people to look at, as (H, W, 3) uint8 RGB."""
    SHOTS.mkdir(parents=True, exist_ok=True)
    path = SHOTS / f"{name}.png"
    page.screenshot(path=path)
    return np.asarray(Image.open(path).convert("RGB"))


def covered(page: Page, name: str) -> float:
    """The share of the map, beside the panel, that shows ground."""
    seen = picture(page, name)[60:760, 400:1300].astype(int)
    return float((np.abs(seen - BACKGROUND).max(axis=2) > 24).mean())


def settle(page: Page) -> None:
    # Not wait_for_function: the page's security policy forbids evaluating strings inside it.
    wait_until(page, lambda: page.evaluate("Boolean(window.missionMap && window.missionMap.settled)"), 20)
    page.wait_for_timeout(900)  # the camera's own movement


def wait_until(page: Page, happened: Callable[[], bool], patience_s: float = 10) -> None:
    deadline = time.monotonic() + patience_s
    while not happened():
        assert time.monotonic() < deadline, "it did not happen"
        page.wait_for_timeout(50)


def width(view: list[float]) -> float:
    """Degrees of longitude from the left to the right edge."""
    return view[2] - view[0]


def hide_drawings(page: Page) -> None:
    for name in ("Photo footprints", "Flight tracks"):
        page.get_by_label(name).uncheck()


def asked_tiles(page: Page) -> set[tuple[int, ...]]:
    asked: set[tuple[int, ...]] = set()

    def note(url: str) -> None:
        match = TILE.search(url)
        if match:
            asked.add(tuple(int(part) for part in match.groups()))

    page.on("request", lambda request: note(request.url))
    return asked


def stat(page: Page, label: str) -> Callable[[str], None]:
    value = page.locator(".stat", has=page.get_by_text(label, exact=True)).locator("dd")
    return lambda text: expect(value).to_have_text(text)


def test_the_map_grows_while_one_watches(page: Page, mission: Mission, shots: list[Shot]) -> None:
    page.goto(mission.url)
    expect(page.get_by_text("Waiting for the first photos")).to_be_visible()
    expect(page.locator(".pill")).to_have_text("Waiting")
    picture(page, "1-waiting")
    hide_drawings(page)

    mission.fly(shots[:6])
    expect(page.get_by_text("Waiting for the first photos")).to_be_hidden()
    stat(page, "On the map")("6")
    wait_until(page, lambda: covered(page, "2-first-tiles") > 0.15)

    mission.fly(shots[6:24])
    stat(page, "On the map")("24")
    mission.fly(shots[24:])
    stat(page, "On the map")("42")
    expect(page.locator(".headline")).to_have_text("42of 42 photos on the map")
    expect(page.locator(".pill")).to_have_text("Live")
    wait_until(page, lambda: covered(page, "3-whole-flight") > 0.6)
    settle(page)
    for name in ("Photo footprints", "Flight tracks"):
        page.get_by_label(name).check()
    page.wait_for_timeout(400)
    picture(page, "4-with-footprints-and-tracks")
    assert [t.strip() for t in page.locator(".legend li").all_inner_texts()] == [
        "Drone 1",
        "Drone 2",
        "Drone 3",
    ]


def test_only_changed_tiles_are_asked_for_again(page: Page, mission: Mission, shots: list[Shot]) -> None:
    mission.fly(shots)
    page.goto(mission.url)
    settle(page)
    asked = asked_tiles(page)
    light = picture(page, "13-before-the-change")
    east = [s for s in shots if s.meta.drone == "Drone 3"]
    mission.light = 0.5  # what is drawn from now on looks different
    mission.pose([replace(s, pose=replace(s.pose, center=s.pose.center + 0.5)) for s in east])
    assert mission.publish() == 2
    stat(page, "Revision")("2")
    settle(page)
    assert asked
    assert asked < {tuple(key) for key in mission.changed}  # not those of the zooms that are not shown
    darker = picture(page, "14-after-the-change")
    assert darker[300:700, 1000:1250].mean() < 0.8 * light[300:700, 1000:1250].mean()


def test_the_map_follows_until_somebody_moves_it(page: Page, mission: Mission, shots: list[Shot]) -> None:
    shots = sorted(shots, key=lambda s: s.name)  # from west to east
    mission.fly(shots[:4])
    page.goto(mission.url)
    settle(page)

    def view() -> list[float]:
        found: list[float] = page.evaluate("missionMap.map.getBounds().toArray().flat()")
        return found

    small = view()
    mission.fly(shots[4:10])
    wait_until(page, lambda: width(view()) > 1.1 * width(small))
    settle(page)
    button = page.get_by_role("button", name="Show whole map")
    expect(button).to_be_hidden()
    page.mouse.move(800, 400)
    page.mouse.down()
    page.mouse.move(900, 470, steps=4)
    page.mouse.up()
    expect(button).to_be_visible()
    page.wait_for_timeout(800)
    moved = view()
    mission.fly(shots[10:])
    stat(page, "On the map")("42")
    page.wait_for_timeout(1500)
    assert view() == moved
    button.click()
    lons = [s.meta.gps.lon_deg for s in shots if s.meta.gps]
    wait_until(page, lambda: view()[0] < min(lons) and max(lons) < view()[2])
    expect(button).to_be_hidden()


def test_a_lost_connection_is_shown_and_made_up_for(
    page: Page, service: Service, mission: Mission, shots: list[Shot]
) -> None:
    mission.fly(shots[:4])
    page.goto(mission.url)
    stat(page, "On the map")("4")
    service.stop()
    expect(page.get_by_text("Connection lost")).to_be_visible(timeout=10_000)
    picture(page, "5-connection-lost")
    mission.fly(shots[4:8])
    service.start()
    expect(page.get_by_text("Connection lost")).to_be_hidden(timeout=20_000)
    stat(page, "On the map")("8")


def test_photos_go_up_from_the_browser(page: Page, service: Service, tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    photos = []
    for i in range(5):
        path = tmp_path / f"DJI_{i:04d}.JPG"
        Image.fromarray(rng.integers(0, 255, (120, 160, 3), np.uint8)).save(path)
        photos.append(path)
    torn = tmp_path / "DJI_9999.JPG"
    torn.write_bytes(photos[0].read_bytes()[:40])
    notes = tmp_path / "notes.txt"
    notes.write_text("no photo")
    page.goto(service.url)
    expect(page.get_by_text("No mission yet")).to_be_visible()
    picture(page, "6-no-mission")
    page.get_by_label("Name of the new mission").fill("Quarry <north>")
    with page.expect_file_chooser() as chooser:
        page.get_by_role("button", name="Drop a flight").click()
    chooser.value.set_files([*photos, torn, notes])
    page.wait_for_url(re.compile("/missions/"))
    expect(page.get_by_role("heading", name="Quarry <north>")).to_be_visible()
    stat(page, "Uploaded")("6")
    stat(page, "Rejected")("1")
    expect(page.get_by_text("6 of 6 sent · 1 refused · 1 not photos, left out")).to_be_visible()
    expect(page.get_by_text("Reading the first photos")).to_be_visible()
    page.locator("summary", has_text="Rejected photos").click()
    expect(page.locator("ul.rejected")).to_contain_text("DJI_9999.JPG")
    expect(page.locator("ul.rejected")).to_contain_text("The photo ends before its picture does.")
    picture(page, "7-uploaded")
    page.get_by_role("link", name="Missions").click()
    row = page.get_by_role("link", name="Quarry <north>")
    expect(row).to_contain_text("0 of 5 photos on the map · 1 rejected")
    picture(page, "8-missions")


def test_a_refusal_is_listed_though_its_event_never_comes(
    page: Page, service: Service, mission: Mission
) -> None:
    """The count may come with the mission's document before its event does."""
    quiet = {"content_type": "text/event-stream", "body": ": nothing\n\n"}
    page.route("**/events*", lambda route: route.fulfill(**quiet))
    page.goto(mission.url)
    stat(page, "Rejected")("0")
    page.wait_for_load_state("networkidle")
    with service.db.write() as tx:
        frames.record_rejected_upload(tx, mission.mission_id, "b" * 32, "DJI_0043.JPG", 9, TruncatedImage())
    stat(page, "Rejected")("1")
    page.locator("summary", has_text="Rejected photos").click()
    expect(page.locator("ul.rejected")).to_contain_text("DJI_0043.JPG")


SUBMAPS = {
    "submaps": [
        {"index": 0, "submap": 0, "frames": 14, "drone": "Drone 1", "georeferenced_by": "gps"},
        {"index": 1, "submap": 0, "frames": 14, "drone": "Drone 2", "georeferenced_by": "tie"},
        {"index": 2, "submap": 5, "frames": 13, "drone": "Drone 3", "georeferenced_by": "none"},
        {"index": 3, "submap": None, "frames": 1, "drone": "Drone 3", "georeferenced_by": "none"},
    ],
    "ties": [
        {
            "low": 0,
            "high": 1,
            "strength": 61.4,
            "frames": 9,
            "points": 377,
            "angle_deg": 12.1,
            "accepted": True,
        }
    ],
    "tried_pairs": 12,
    "dropped_pairs": 0,
}


def test_what_waits_for_a_tie_is_told_and_submaps_are_listed(
    page: Page, mission: Mission, shots: list[Shot]
) -> None:
    mission.fly([s for s in shots if s.meta.drone != "Drone 3"])
    late = [s for s in shots if s.meta.drone == "Drone 3"]
    mission.receive([replace(s, meta=replace(s.meta, gps=None)) for s in late])
    page.goto(mission.url)
    expect(page.locator(".notice")).to_be_hidden()
    mission.save(PoseUpdate(waiting={s.frame_id: s.pose for s in late}, submaps=SUBMAPS))
    expect(page.locator(".notice")).to_contain_text("14 photos without GPS wait for a tie")
    expect(page.locator(".headline")).to_have_text("28of 42 photos on the map")
    stat(page, "Rejected")("0")
    page.locator("summary", has_text="Submaps").click()
    rows = page.locator(".submaps .rows").first.locator("li")
    expect(rows).to_have_text(
        [
            re.compile("1.*Drone 1.*14 photos.*by GPS"),
            re.compile("2.*Drone 2.*14 photos.*by a tie"),
            re.compile("3.*Drone 3.*13 photos.*waits for a tie"),
            "and 1 photo in 1 smaller submap",
        ]
    )
    expect(page.locator(".submaps .rows").last).to_contain_text("1 – 2strength 61")
    settle(page)
    picture(page, "15-waiting-and-submaps")
    page.locator(".submaps .rows").last.scroll_into_view_if_needed()
    picture(page, "17-ties")
    mission.pose(late)  # a photo that saw both came in
    expect(page.locator(".notice")).to_be_hidden()


def test_a_map_without_gps_says_so_and_takes_a_first_height(
    page: Page, service: Service, mission: Mission, shots: list[Shot]
) -> None:
    mission.fly([replace(s, pose=replace(s.pose, source="vision-only")) for s in shots[:9]])
    page.goto(mission.url)
    notice = page.locator(".notice")
    expect(notice).to_contain_text("Not georeferenced. No photo has GPS: place, north and scale are assumed.")
    page.get_by_label("Height of the first photo above ground, metres").fill("62.5")
    settle(page)
    picture(page, "16-not-georeferenced")
    page.get_by_role("button", name="Set scale").click()
    expect(notice).to_contain_text("the scale is as it was given")
    with service.db.read() as tx:
        assert missions.get(tx, mission.mission_id).scale == {"first_height_m": 62.5, "marker": None}


def asked_for(service: Service, mission: Mission, name: str) -> int:
    """The revision that a file was asked of, once the API knows that it was."""
    deadline = time.monotonic() + 15
    while time.monotonic() < deadline:
        with service.db.read() as tx:
            row = exports.get(tx, mission.mission_id, name)
        if row is not None and row.state == "wanted":
            return row.revision
        time.sleep(0.05)
    raise AssertionError(f"nobody asked for {name}")


def test_finalising_and_downloads(page: Page, service: Service, mission: Mission, shots: list[Shot]) -> None:
    mission.fly(shots[:4])
    with service.db.write() as tx:
        frames.record_rejected_upload(tx, mission.mission_id, "a" * 32, "DJI_0042.JPG", 9, TruncatedImage())
    page.goto(mission.url)
    page.get_by_role("button", name="Orthophoto").click()
    expect(page.get_by_text("being made…")).to_be_visible()
    key = f"missions/{mission.mission_id}/exports/1/mosaic.tif"
    service.store.put(key, b"the mosaic")
    revision = asked_for(service, mission, "mosaic.tif")
    with page.expect_download() as download, service.db.write() as tx:
        assert exports.finish(tx, mission.mission_id, "mosaic.tif", revision, key, 10, "image/tiff")
    assert Path(download.value.path()).read_bytes() == b"the mosaic"
    row = page.get_by_role("button", name="Orthophoto").locator(".size")
    expect(row).to_have_text("10 B", timeout=15_000)
    mission.fly(shots[4:8])
    expect(row).to_have_text("", timeout=15_000)  # a click brings another file by now
    route = page.get_by_role("button", name="Flight route")
    route.click()
    expect(route).to_contain_text("being made…")
    revision = asked_for(service, mission, "route.csv")
    with service.db.write() as tx:
        assert exports.fail(tx, mission.mission_id, "route.csv", revision, "There is no room for it.")
    expect(route.locator(".why")).to_have_text("There is no room for it.", timeout=15_000)
    expect(route).to_be_enabled()
    page.get_by_role("button", name="Finalise map").click()
    expect(page.locator(".pill")).to_have_text("Finalising")
    expect(page.get_by_role("button", name="Finalise map")).to_be_disabled()
    picture(page, "9-finalising")


def test_a_phone_shows_the_map_and_unfolds_the_rest(
    browser: Browser, mission: Mission, shots: list[Shot]
) -> None:
    mission.fly(shots)
    context = browser.new_context(
        viewport={"width": 390, "height": 844}, device_scale_factor=2, has_touch=True, is_mobile=True
    )
    page = context.new_page()
    page.goto(mission.url)
    stat(page, "On the map")("42")
    settle(page)
    picture(page, "10-phone")
    assert page.evaluate("document.documentElement.scrollWidth") == 390
    expect(page.get_by_text("Layers")).to_be_hidden()
    page.get_by_role("button", name="Show or hide the details").tap()
    expect(page.get_by_text("Layers")).to_be_visible()
    page.wait_for_timeout(300)
    picture(page, "11-phone-details")
    context.close()


def test_the_reference_of_the_api_is_there(page: Page, service: Service) -> None:
    page.goto(f"{service.url}/docs")
    page.locator("summary", has_text="/api/v1/missions/{mission_id}/frames").first.click()
    expect(page.get_by_text("Upload photos.")).to_be_visible()
    picture(page, "12-reference")


def test_a_mission_that_is_not_there(page: Page, service: Service) -> None:
    page.goto(f"{service.url}/missions/nowhere")
    expect(page.get_by_text("There is no such mission")).to_be_visible()
