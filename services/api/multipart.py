"""Multipart uploads as they come in: photos go straight to files, hashed on the way, never held in RAM."""

from __future__ import annotations

import hashlib
import uuid
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from python_multipart.exceptions import FormParserError
from python_multipart.multipart import MultipartParser, parse_options_header

from services.api.problems import BadUpload, TooManyPhotos

if TYPE_CHECKING:
    from python_multipart.multipart import MultipartCallbacks

_FIELD_LIMIT = 8_000_000  # bytes of telemetry
_NAME_LIMIT = 200  # characters of a photo's name
_MAX_PARTS = 2000


@dataclass(frozen=True, slots=True)
class ReceivedFile:
    """One photo as it arrived: `path` is a temporary file with its bytes, None when they passed the limit."""

    name: str
    path: Path | None
    size_bytes: int
    frame_id: str

    def discard(self) -> None:
        """Remove the temporary file if it is still there."""
        if self.path is not None:
            self.path.unlink(missing_ok=True)


def clean_name(raw: str) -> str:
    """A photo's name as data: no folders, nothing unprintable, at most 200 characters, never empty."""
    base = raw.replace("\\", "/").rsplit("/", 1)[-1]
    shown = "".join(c for c in base if c.isprintable()).strip()
    stem, dot, suffix = shown.rpartition(".")
    if dot and len(suffix) <= 8:
        shown = stem[: _NAME_LIMIT - len(suffix) - 1] + dot + suffix
    return shown[:_NAME_LIMIT] or "photo"


class FormReader:
    """Feeds on the body's chunks; photos that are complete wait in `finished`, the telemetry in `fields`."""

    def __init__(self, content_type: str, folder: Path, max_file_bytes: int) -> None:
        """`folder` takes the temporary files. Raises BadUpload when the body cannot be multipart."""
        kind, options = parse_options_header(content_type)
        if kind != b"multipart/form-data" or not options.get(b"boundary"):
            raise BadUpload
        self.finished: list[ReceivedFile] = []
        self.fields: dict[str, bytes] = {}
        self.late_fields: set[str] = set()  # those that came behind a photo
        self._files_begun = 0
        self._folder = folder
        self._limit = max_file_bytes
        self._parts = 0
        self._complete = False
        self._header: tuple[bytearray, bytearray] = (bytearray(), bytearray())
        self._disposition = ""
        self._field: tuple[str, bytearray] | None = None
        self._file: _Incoming | None = None
        try:
            self._parser = MultipartParser(options[b"boundary"], self._callbacks())
        except FormParserError as error:
            raise BadUpload from error

    def feed(self, chunks: Iterable[bytes]) -> None:
        """Take more of the body. Raises BadUpload, TooManyPhotos, OSError."""
        try:
            self._parser.write(b"".join(chunks))
        except FormParserError as error:
            raise BadUpload(f"The multipart body is damaged: {error}.") from error

    def end(self) -> None:
        """The body is over; raises BadUpload when the form is not."""
        if not self._complete:
            raise BadUpload("The multipart body ends before its last boundary. Send it again.")

    def close(self) -> None:
        """Remove whatever was not taken out of `finished`."""
        if self._file:
            self._file.abandon()
        for file in self.finished:
            file.discard()

    def _callbacks(self) -> MultipartCallbacks:
        return {
            "on_part_begin": self._begin,
            "on_header_field": lambda data, start, end: self._header[0].extend(data[start:end]),
            "on_header_value": lambda data, start, end: self._header[1].extend(data[start:end]),
            "on_header_end": self._header_end,
            "on_headers_finished": self._headers_finished,
            "on_part_data": self._data,
            "on_part_end": self._part_end,
            "on_end": self._end,
        }

    def _begin(self) -> None:
        self._parts += 1
        if self._parts > _MAX_PARTS:
            raise TooManyPhotos(f"One request may hold {_MAX_PARTS} photos at most. Send them in several.")
        self._disposition = ""

    def _header_end(self) -> None:
        name, value = self._header
        if name.lower() == b"content-disposition":
            self._disposition = value.decode("utf-8", "replace")
        self._header = (bytearray(), bytearray())

    def _headers_finished(self) -> None:
        name, filename = _names(self._disposition)
        if filename is None and name != "files":
            self._field = (name, bytearray())
        else:
            self._files_begun += 1
            self._file = _Incoming(clean_name(filename or ""), self._folder, self._limit)

    def _data(self, data: bytes, start: int, end: int) -> None:
        piece = memoryview(data)[start:end]
        if self._file:
            self._file.write(piece)
        elif self._field:
            if len(self._field[1]) + len(piece) > _FIELD_LIMIT:
                raise BadUpload(f"The field {self._field[0]!r} is larger than {_FIELD_LIMIT / 1e6:.0f} MB.")
            self._field[1].extend(piece)

    def _part_end(self) -> None:
        if self._file:
            self.finished.append(self._file.finish())
            self._file = None
        elif self._field:
            self.fields[self._field[0]] = bytes(self._field[1])
            if self._files_begun:
                self.late_fields.add(self._field[0])
            self._field = None

    def _end(self) -> None:
        self._complete = True


class _Incoming:
    """One photo being written; past the limit it is only counted and hashed any more."""

    def __init__(self, name: str, folder: Path, limit: int) -> None:
        self._name, self._limit = name, limit
        self._path: Path | None = folder / f"upload-{uuid.uuid4().hex}"
        self._file = self._path.open("xb", buffering=0)
        self._digest = hashlib.sha256()
        self._size = 0

    def write(self, piece: memoryview) -> None:
        self._size += len(piece)
        self._digest.update(piece)
        if self._size > self._limit:
            self.abandon()
        else:
            while piece:
                piece = piece[self._file.write(piece) :]

    def finish(self) -> ReceivedFile:
        self._file.close()
        return ReceivedFile(self._name, self._path, self._size, self._digest.hexdigest()[:32])

    def abandon(self) -> None:
        self._file.close()
        if self._path:
            self._path.unlink(missing_ok=True)
            self._path = None


def _names(disposition: str) -> tuple[str, str | None]:
    """The part's field name, and its file's name if it is a file."""
    # The parser works in latin-1, as the wire does; names are UTF-8.
    _, options = parse_options_header(disposition.encode("utf-8").decode("latin-1"))
    name = options.get(b"name", b"").decode("utf-8", "replace")
    filename = options.get(b"filename")
    return name, None if filename is None else filename.decode("utf-8", "replace")
