"""What a client has already: the one comparison of `If-None-Match`."""

from __future__ import annotations

from fastapi import Request


def has(request: Request, etag: str) -> bool:
    """Whether the request says that its sender has what `etag` stands for (weakly compared, RFC 9110)."""
    offered = request.headers.get("if-none-match", "")
    return offered.strip() == "*" or etag in (e.strip().removeprefix("W/") for e in offered.split(","))
