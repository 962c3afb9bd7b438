"""The one exception family of orthostream: the class docstring is the message, `code` is what programs read.

Ordinary absence is `None`; these are for promises that cannot be kept.
"""

from __future__ import annotations

import inspect


class OrthostreamError(Exception):
    """Something in orthostream went wrong."""

    code = "error"

    def __init__(self, detail: str | None = None) -> None:
        """`detail` replaces the class docstring as the message."""
        super().__init__(detail or inspect.cleandoc(type(self).__doc__ or type(self).__name__))


class RejectedFrame(OrthostreamError):
    """The photo cannot become part of the map."""

    code = "rejected"


class EmptyFile(RejectedFrame):
    """The file has 0 bytes: the copy from the card or the upload broke off. Copy it again."""

    code = "empty_file"


class NotAnImage(RejectedFrame):
    """The file is neither a JPEG nor a TIFF photo. Upload the camera's own JPEG or TIFF files."""

    code = "not_an_image"


class TruncatedImage(RejectedFrame):
    """The photo ends before its picture does. Copy it from the card again."""

    code = "truncated_image"


class FileTooLarge(RejectedFrame):
    """The file is larger than the limit of the service. Export a smaller JPEG of it."""

    code = "file_too_large"


class TooManyPixels(RejectedFrame):
    """The photo has more pixels than the limit of the service. Export a smaller JPEG of it."""

    code = "too_many_pixels"


class TooFewPixels(RejectedFrame):
    """The photo is too small to be matched (under 64 pixels a side). Upload the original, no thumbnail."""

    code = "too_few_pixels"


class PhotoLost(RejectedFrame):
    """The photo's file is gone from the storage. Upload it again."""

    code = "photo_lost"


class FarFromMission(RejectedFrame):
    """The photo's GPS lies far away from the rest of the mission. Put it into a mission of its own."""

    code = "far_from_mission"


class NotPlaceable(RejectedFrame):
    """The photo has no usable GPS and ties to no other photo. Fly with more overlap, or send its position."""

    code = "not_placeable"


class Oblique(RejectedFrame):
    """The photo shows the horizon or looks too far sideways for a map. Point the camera straight down."""

    code = "oblique"


class BadTelemetry(OrthostreamError):
    """The telemetry sent with the photo cannot be read."""

    code = "bad_telemetry"


class NothingToMap(OrthostreamError):
    """No photo of the mission could be placed, so that there is no map to make."""

    code = "nothing_to_map"


class BadCheckpoints(OrthostreamError):
    """The checkpoint file is not a gcp_list.txt: a line with the CRS, then X Y Z px py image [name]."""

    code = "bad_checkpoints"


class BadScale(OrthostreamError):
    """What is said of the mission's scale makes no sense."""

    code = "bad_scale"


class BadCrs(OrthostreamError):
    """The coordinate reference system is not known. Name one such as EPSG:32632."""

    code = "bad_crs"
