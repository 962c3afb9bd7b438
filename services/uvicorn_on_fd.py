"""Runs the API on a listening socket that its parent opened: `python -m services.uvicorn_on_fd FD`.

uvicorn's own --fd takes every socket for a unix one, and then leaves Nagle's delay on. While the API is
started again callers wait in the parent's socket instead of being refused.
"""

from __future__ import annotations

import gc
import socket
import sys

import uvicorn


class _Server(uvicorn.Server):
    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        gc.collect()
        gc.freeze()  # every route and table: a collector would go through them time and again for nothing


def main() -> None:
    """Serves until SIGTERM."""
    listener = socket.socket(fileno=int(sys.argv[1]))
    config = uvicorn.Config(
        "services.api.app:create_app",
        factory=True,
        access_log=False,
        log_level="warning",
        timeout_graceful_shutdown=2,
    )
    _Server(config).run(sockets=[listener])


if __name__ == "__main__":
    main()
