"""The XMP packet of a photo as a flat mapping from property to text.

Read by expat with document types refused, so that no entity can be declared, let alone expanded; native XMP
libraries were left out because a broken photo must never take the process with it.
"""

from __future__ import annotations

from contextlib import suppress
from xml.parsers import expat

_MAX_BYTES = 1_000_000
_WRAPPERS = ("x:xmpmeta", "rdf:RDF", "rdf:Description", "rdf:Seq", "rdf:Bag", "rdf:Alt", "rdf:li")


class _DocumentType(Exception):
    """An XMP packet has no document type: this one is an attack or garbage."""


class _Collector:
    def __init__(self) -> None:
        self.found: dict[str, str] = {}
        self._path: list[str] = []
        self._text: list[str] = []

    def start(self, name: str, attributes: dict[str, str]) -> None:
        self._path.append(name)
        self._text = []
        for key, value in attributes.items():
            if not key.startswith(("xmlns", "rdf:", "xml:")):
                self._keep(key, value)

    def end(self, name: str) -> None:
        text = "".join(self._text).strip()
        if text:
            self._keep(None, text)
        self._text = []
        self._path.pop()

    def text(self, data: str) -> None:
        self._text.append(data)

    def doctype(self, *_: object) -> None:
        raise _DocumentType

    def _keep(self, attribute: str | None, value: str) -> None:
        named = [*self._path, attribute] if attribute else self._path
        key = "/".join(part for part in named if part and part not in _WRAPPERS)
        if key:
            self.found.setdefault(key, value.strip())


def parse_xmp(packet: bytes) -> dict[str, str]:
    """An XMP packet → {"drone-dji:GimbalYawDegree": "+45.00", "outer:Name/inner:Name": "…"}, never raises.

    Prefixes as written (makers always write the same), attributes and elements alike, structures joined by
    "/". A packet that is broken in the middle gives what stands before the break.
    """
    collector = _Collector()
    parser = expat.ParserCreate()
    parser.StartElementHandler = collector.start
    parser.EndElementHandler = collector.end
    parser.CharacterDataHandler = collector.text
    parser.StartDoctypeDeclHandler = collector.doctype
    # A maker's broken XML is no error: the values before the break are still good.
    with suppress(expat.ExpatError, _DocumentType, ValueError, LookupError):
        parser.Parse(packet[:_MAX_BYTES].strip(b"\x00 \r\n\t"), True)
    return collector.found
