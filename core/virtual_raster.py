"""Many small rasters as one: what GDAL calls a virtual raster, with overviews, as a few XML files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree as ET

from rasterio import Affine

_BANDS = ("Red", "Green", "Blue", "Alpha")


@dataclass(frozen=True, slots=True)
class Patch:
    """A whole RGBA file, `width` × `height` pixels, and where its top-left pixel lies in the raster."""

    file: str
    col: int
    row: int
    width: int
    height: int


@dataclass(frozen=True, slots=True)
class Virtual:
    """A raster of RGBA patches, transparent elsewhere. `transform`: pixel corners → `crs`."""

    width: int
    height: int
    transform: Affine
    crs: str
    patches: Sequence[Patch]
    tags: Mapping[str, str]


def write_virtual(folder: Path, levels: Sequence[Virtual]) -> Path:
    """A raster and its overviews, finest first, of files in `folder`: the path of what opens them all."""
    for level, raster in enumerate(levels):
        coarser = range(1, len(levels)) if level == 0 else range(0)
        tree = ET.ElementTree(_dataset(raster, [_name(k) for k in coarser]))
        tree.write(folder / _name(level), "utf-8", xml_declaration=True)
    return folder / _name(0)


def _name(level: int) -> str:
    return f"{level}.vrt"


def _dataset(raster: Virtual, overviews: Sequence[str]) -> ET.Element:
    size = {"rasterXSize": str(raster.width), "rasterYSize": str(raster.height)}
    root = ET.Element("VRTDataset", size)
    ET.SubElement(root, "SRS").text = raster.crs
    ET.SubElement(root, "GeoTransform").text = ",".join(map(repr, map(float, raster.transform.to_gdal())))
    root.append(_metadata(raster.tags))
    for number, colour in enumerate(_BANDS, 1):
        band = ET.SubElement(root, "VRTRasterBand", dataType="Byte", band=str(number))
        ET.SubElement(band, "ColorInterp").text = colour
        for name in overviews:
            _source(ET.SubElement(band, "Overview"), name, number)
        for patch in raster.patches:
            _place(band, patch, number)
    return root


def keep_tags(path: Path, tags: Mapping[str, str]) -> None:
    """Have a virtual raster that GDAL wrote say these too: a warped one forgets what its source said."""
    tree = ET.parse(path)
    root = tree.getroot()
    assert root is not None
    root.insert(0, _metadata(tags))
    tree.write(path, "utf-8", xml_declaration=True)


def _metadata(tags: Mapping[str, str]) -> ET.Element:
    told = ET.Element("Metadata")
    for key, value in sorted(tags.items()):
        ET.SubElement(told, "MDI", key=key).text = value
    return told


def _place(band: ET.Element, patch: Patch, number: int) -> None:
    source = ET.SubElement(band, "SimpleSource")
    _source(source, patch.file, number)
    size = {"xSize": str(patch.width), "ySize": str(patch.height)}
    ET.SubElement(source, "SrcRect", {"xOff": "0", "yOff": "0"} | size)
    ET.SubElement(source, "DstRect", {"xOff": str(patch.col), "yOff": str(patch.row)} | size)


def _source(element: ET.Element, name: str, number: int) -> None:
    ET.SubElement(element, "SourceFilename", relativeToVRT="1").text = name
    ET.SubElement(element, "SourceBand").text = str(number)
