"""`--gcp` and `--use-gcp`: surveyed points on their way to the mission, and what its report says of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from core.checkpoints import Checkpoints, parse_gcp_list
from core.errors import BadCheckpoints
from services.cli.client import Client

GcpFile = Annotated[Path | None, typer.Option(help="Surveyed points (ODM's gcp_list.txt) to check against.")]
UsedPoints = Annotated[
    list[str] | None,
    typer.Option(metavar="NAME[,NAME…]", help="Points of --gcp that enter the solution; the rest checks it."),
]


@dataclass(frozen=True, slots=True)
class Survey:
    """A gcp_list.txt as it is sent, and the points that are to hold the map in place."""

    content: str
    use: tuple[str, ...]


def read_survey(path: Path | None, use: Sequence[str]) -> Survey | None:
    """The surveyed points of a gcp_list.txt. `use`: names, several parted by commas in one.

    Raises BadCheckpoints with what is wrong, before anything is uploaded.
    """
    if path is None:
        if use:
            raise BadCheckpoints("--use-gcp names points of a file: add --gcp gcp_list.txt.")
        return None
    try:
        content = path.read_text("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise BadCheckpoints(f"The checkpoint file {path} cannot be read: {error}.") from error
    points = parse_gcp_list(content)
    return Survey(content, tuple(sorted(points.using(_names(points, use)).used)))


def _names(points: Checkpoints, use: Sequence[str]) -> list[str]:
    """A point without a name is called after its place, which holds a comma itself."""
    known = set(points.points)
    return [n.strip() for text in use for n in ([text] if text in known else text.split(",")) if n.strip()]


def send_survey(client: Client, mission_id: str, survey: Survey | None) -> None:
    """Makes the mission's surveyed points these."""
    if survey is None:
        client.survey(mission_id, None)
    else:
        client.survey(mission_id, survey.content, survey.use)


def checkpoint_rows(checked: Mapping[str, Any] | None) -> list[tuple[str, str]]:
    """Lines of the summary: how far the points lie off, through the poses and in the mosaic."""
    if not checked:
        return []
    rows = []
    used = [p["point"] for p in checked["points"] if p["used"]]
    if used:
        rows.append(("held by", ", ".join(used)))
    poses, mosaic = checked["poses"], checked["mosaic"]
    if poses:
        seen = f"{_points(poses['points'])} in {poses['sightings']} photos"
        errors = _errors(poses["plane_raw_m"], poses["plane_debiased_m"], poses["plane_similarity_m"])
        rows.append(("checkpoints, poses", f"{seen}: {errors}"))
    if mosaic:
        found = f"{mosaic['found']} of {_points(mosaic['points'])} found"
        if mosaic["found"]:
            found += f": {_errors(mosaic['raw_m'], mosaic['debiased_m'], mosaic['similarity_m'])}"
        rows.append(("checkpoints, mosaic", found))
    lost = [(why, [p["point"] for p in checked["points"] if p["unseen"] == why]) for why in _UNSEEN]
    rows += [("checkpoints, not seen", f"{', '.join(names)}: {_UNSEEN[why]}") for why, names in lost if names]
    return rows


_UNSEEN = {
    "no_photo": "none of their photos is in the mission",
    "not_posed": "none of their photos is on the map by its picture",
}


def _points(number: int) -> str:
    return f"{number} point" + "s" * (number != 1)


def _errors(raw_m: float, debiased_m: float | None, similarity_m: float | None) -> str:
    said = [f"{raw_m:.2f} m"]
    said += [f"{debiased_m:.2f} m less the mean shift"] if debiased_m is not None else []
    said += [f"{similarity_m:.2f} m after a similarity"] if similarity_m is not None else []
    return ", ".join(said)
