"""Runs the API on a listening socket that its parent opened: `python -m services.uvicorn_on_fd FD`.

uvicorn's own --fd takes every socket for a unix one, and then leaves Nagle's delay on. While the API is
started again callers wait in the parent's socket instead of being refused.
"""

from __future__ import annotations

import socket
import sys

import uvicorn


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
    uvicorn.Server(config).run(sockets=[listener])


if __name__ == "__main__":
    main()
