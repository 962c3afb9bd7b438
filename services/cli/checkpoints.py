"""`--gcp`: how far surveyed points lie off, measured in the files that came out; added to report.json."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from pyproj import Transformer

from core.checkpoints import Checkpoints, checkpoint_errors, parse_gcp_list
from core.errors import BadCheckpoints
from core.geometry import Array, Camera, Pose, PosedFrame, World


class _Plane(World):
    """poses.json's own CRS taken for a world: its coordinates are used as they are written."""

    to_crs: Transformer

    def from_geodetic(self, lon_lat_alt: Array) -> Array:
        """Longitude, latitude, height (N, 3) → the CRS's easting, northing, height (N, 3)."""
        east, north = self.to_crs.transform(lon_lat_alt[:, 0], lon_lat_alt[:, 1])
        return np.column_stack((east, north, lon_lat_alt[:, 2]))


def read_gcp(path: Path) -> Checkpoints:
    """The surveyed points of a gcp_list.txt. Raises BadCheckpoints with what is wrong."""
    try:
        return parse_gcp_list(path.read_text())
    except (OSError, UnicodeDecodeError) as error:
        raise BadCheckpoints(f"The checkpoint file {path} cannot be read: {error}.") from error


def add_checkpoints(points: Checkpoints, photos: Path, out: Path) -> None:
    """Writes the points' errors into the report."""
    document = json.loads((out / "poses.json").read_text())
    plane = _Plane(0.0, 0.0)
    object.__setattr__(plane, "to_crs", Transformer.from_crs(4326, document["crs"], always_xy=True))
    errors = checkpoint_errors(points, plane, _frames(document))
    path = out / "report.json"
    report = json.loads(path.read_text())
    report["checkpoints"] = None if errors is None else errors.to_json()
    path.write_text(json.dumps(report, indent=1))


def _frames(document: dict[str, Any]) -> dict[str, PosedFrame]:
    cameras = [Camera(**{k: v for k, v in c.items() if k != "model"}) for c in document["cameras"]]
    return {f["name"]: PosedFrame(f["name"], cameras[f["camera"]], _pose(f)) for f in document["frames"]}


def _pose(frame: dict[str, Any]) -> Pose:
    center = np.array(frame["center"], float)
    return Pose(np.array(frame["R"], float), center, frame["ground_height"], frame["source"])
