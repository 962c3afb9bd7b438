"""Every export of a real stack: of one revision while the map grows, the same bytes once it is final."""

from __future__ import annotations

import json
import time
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import rasterio
from PIL import Image
from pmtiles.reader import MmapSource, all_tiles
from rio_cogeo.cogeo import cog_validate

from core.mosaic import Mosaic
from services.cli.client import Client
from services.cli.flight import find_photos
from services.export_names import NAMES


def read_pmtiles(path: Path) -> dict[tuple[int, int, int], bytes]:
    with path.open("rb") as file:
        return {zxy: bytes(data) for zxy, data in all_tiles(MmapSource(file))}


def test_exports_of_a_growing_and_of_a_final_map(
    new_stack: Callable[..., Any],
    finish: Callable[[Client, str], None],
    flight: Path,
    oracle: Mosaic,
    tmp_path: Path,
) -> None:
    stack = new_stack().start()
    client = Client(stack.url)
    mission_id = client.create("Flood plain", "visual", None)
    api = httpx.Client(base_url=f"{stack.url}/api/v1/missions/{mission_id}", timeout=30)
    revisions = set()
    for k, photo in enumerate(find_photos(flight)):
        client.upload(mission_id, photo.name, photo.path.read_bytes())
        if k % 4 == 3:
            while client.progress(mission_id)["revision"] == 0:
                time.sleep(0.1)
            growing = tmp_path / f"{k}.pmtiles"
            assert client.download(mission_id, "tiles.pmtiles", growing, lambda: None)
            listed = {e["name"]: e for e in api.get("/exports").json()["exports"]}
            revision = listed["tiles.pmtiles"]["revision"]
            revisions.add(revision)
            held = read_pmtiles(growing)
            assert held
            for (z, x, y), data in held.items():
                assert api.get(f"/revisions/{revision}/tiles/{z}/{x}/{y}").content == data
    assert revisions
    while_it_grows = tmp_path / "growing"
    while_it_grows.mkdir()
    for name in NAMES:
        assert client.download(mission_id, name, while_it_grows / name, lambda: None), name
        assert (while_it_grows / name).stat().st_size > 0
    assert client.progress(mission_id)["state"] == "open"
    finish(client, mission_id)
    for name in NAMES:
        assert client.download(mission_id, name, tmp_path / name, lambda: None), name
    _check_final(tmp_path, {tuple(k): v for k, v in oracle.tiles.items()}, mission_id)
    assert client.download(mission_id, "mosaic.tif", tmp_path / "web.tif", lambda: None, "EPSG:3857")
    _check_same_picture(tmp_path / "mosaic.tif", tmp_path / "web.tif")


def _check_final(out: Path, tiles: dict[tuple[int, int, int], bytes], mission_id: str) -> None:
    assert read_pmtiles(out / "tiles.pmtiles") == tiles
    with zipfile.ZipFile(out / "tiles.zip") as folder:
        assert len(folder.namelist()) == 1 + len(tiles)
    with zipfile.ZipFile(out / "map.kmz") as kmz:
        assert len(kmz.namelist()) == 1 + 2 * len(tiles)
    with rasterio.open(out / "tiles.mbtiles") as raster:
        assert raster.crs.to_epsg() == 3857
    item = json.loads((out / "stac.json").read_text())
    assert (item["id"], item["properties"]["title"]) == (mission_id, "Flood plain")
    beside = {asset["href"].removeprefix("./") for asset in item["assets"].values()}
    assert beside <= {p.name for p in out.iterdir()}
    with zipfile.ZipFile(out / "preview.zip") as preview:
        assert preview.read("preview.png") == (out / "preview.png").read_bytes()
    with Image.open(out / "preview.png") as picture:
        assert picture.mode == "RGBA"
        assert 500 < max(picture.size) <= 2048


def _check_same_picture(utm: Path, web: Path) -> None:
    assert cog_validate(web)[0]
    with rasterio.open(utm) as ours, rasterio.open(web) as theirs:
        assert theirs.crs.to_epsg() == 3857
        rng = np.random.default_rng(0)
        columns, rows = (rng.uniform(0.2, 0.8, 400) * n for n in (ours.width, ours.height))
        x, y = (np.asarray(v) for v in rasterio.transform.xy(ours.transform, rows, columns, offset="ul"))
        there = np.transpose(rasterio.warp.transform(ours.crs, theirs.crs, x, y))
        here = np.array(list(ours.sample(np.column_stack((x, y)))), int)
        seen = np.array(list(theirs.sample(there)), int)
    both = (here[:, 3] == 255) & (seen[:, 3] == 255)
    assert both.mean() > 0.7
    assert np.median(np.abs(here - seen)[both]) <= 6
