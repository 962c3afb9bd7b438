"""The surveyed points that hold a map in place, as the pose graph takes them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from pyproj import Transformer

from core.checkpoints import Checkpoints, PhotoNames
from core.pose_graph.model import GraphFrame, Mark


def marks_of(points: Checkpoints | None, frames: Sequence[GraphFrame]) -> tuple[Mark, ...]:
    """The marks of the used points in these photos; none in photos that share a name.

    Altitudes count unless the file gives all points the same one.
    """
    if points is None or not points.used:
        return ()
    often = Counter(f.name for f in frames)
    known = {f.name: f.frame_id for f in frames if often[f.name] == 1}
    names = PhotoNames(often)
    to_wgs84 = Transformer.from_crs(points.crs, 4326, always_xy=True)
    marks = []
    for s in points.sightings:
        name = names.find(s.image)
        if s.point in points.used and name in known:
            lon, lat = to_wgs84.transform(*s.xyz[:2])
            alt_m = s.xyz[2] if points.heights_tell else None
            marks.append(Mark(s.point, known[name], s.uv, float(lon), float(lat), alt_m))
    return tuple(marks)
