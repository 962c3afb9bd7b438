"""The service as a drone or a script sees it: a few HTTP calls that do not give up when the network does."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx

from core.errors import OrthostreamError
from services.errors import OutOfDisk

RETRY_S = 300.0
GREETING_S = 10.0
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.3, 10.0
_AGAIN = (408, 425, 429, 500, 502, 503, 504, 507)
_FULL_DISK = 507
_PATIENCE_S = {500: 30.0, _FULL_DISK: 10.0}  # what more of the same question seldom mends
_SAY_EVERY_S = 30.0


class ServerAway(OrthostreamError):
    """The server does not answer. Is it running, and is its address right?"""

    code = "server_away"


class Refused(OrthostreamError):
    """The server refused the request."""

    code = "refused"


@dataclass(frozen=True, slots=True)
class Uploaded:
    """What the service said of one photo. `detail`: why it was rejected, None when it was taken."""

    name: str
    frame_id: str | None
    state: str
    created: bool
    detail: str | None = None


class Client:
    """One server's API v1. Safe to share between threads."""

    def __init__(
        self, url: str, retry_s: float = RETRY_S, say: Callable[[str], None] = lambda line: None
    ) -> None:
        """`url`: of the server, without a path. `retry_s`: for how long a call tries before it gives up.

        `say`: told, now and then, that the server cannot be reached and what is done about it. Raises
        ServerAway when `url` cannot be one.
        """
        self.url = url.rstrip("/") if "://" in url else f"http://{url.rstrip('/')}"
        self._retry_s = retry_s
        self._say, self._said_at = say, -math.inf
        local = self.url.startswith(("http://127.0.0.1", "http://localhost", "http://[::1]"))
        try:
            self._http = httpx.Client(
                base_url=f"{self.url}/api/v1",
                timeout=httpx.Timeout(60.0, connect=10.0, pool=None),
                limits=httpx.Limits(max_connections=16, max_keepalive_connections=16),
                trust_env=not local,
            )
        except httpx.InvalidURL as error:
            raise ServerAway(f"{self.url!r} is not the address of a server ({error}).") from error

    def close(self) -> None:
        """Drops the connections."""
        self._http.close()

    def greet(self) -> None:
        """Raises ServerAway soon when nobody is there, and Refused when somebody else is."""
        answer = self._stubbornly(lambda: self._http.get(f"{self.url}/health"), GREETING_S)
        if _problem(answer) != {"status": "ok"}:
            raise Refused(f"What answers at {self.url} is not orthostream. Is the address right?")

    def create(
        self,
        name: str,
        mode: str,
        max_side: int | None,
        scale: Mapping[str, Any] | None = None,
        backfill: bool = False,
    ) -> str:
        """A new mission's id. `scale`: as the API knows it."""
        body = {"name": name, "mode": mode, "max_side": max_side, "scale": scale, "backfill": backfill}
        return str(self._json("POST", "/missions", json=body)["id"])

    def scale(self, mission_id: str, scale: Mapping[str, Any] | None) -> None:
        """Says what is known of the scale; None takes it back."""
        self._json("PUT", f"/missions/{mission_id}/scale", json=scale or {})

    def mission(self, mission_id: str) -> dict[str, Any] | None:
        """The mission's document, None when the server does not know it."""
        answer = self._ask("GET", f"/missions/{mission_id}")
        return None if answer.status_code == 404 else self._good(answer).json()

    def progress(self, mission_id: str) -> dict[str, Any]:
        """Counts by state and what else is known of the mission's progress."""
        return self._json("GET", f"/missions/{mission_id}/progress")

    def frames(self, mission_id: str, state: str | None = None) -> list[dict[str, Any]]:
        """All frames, or those of one state."""
        found: list[dict[str, Any]] = []
        after: str | None = None
        while True:
            asked = {"state": state, "after": after, "limit": 1000}
            query = {k: v for k, v in asked.items() if v is not None}
            page = self._json("GET", f"/missions/{mission_id}/frames", params=query)
            found += page["frames"]
            after = page["next"]
            if after is None:
                return found

    def upload(self, mission_id: str, name: str, data: bytes, telemetry: str | None = None) -> Uploaded:
        """Sends one photo, again and again until the service has said what it thinks of it.

        Raises OutOfDisk, Refused, ServerAway.
        """
        fields = {"telemetry": telemetry} if telemetry else None
        answer = self._ask(
            "POST", f"/missions/{mission_id}/frames", files={"files": (name, data)}, data=fields
        )
        if answer.is_success:
            said = answer.json()["frames"][0]
        else:
            problem = _problem(answer)
            if answer.status_code == _FULL_DISK:  # no photo's fault: it has to come again
                raise OutOfDisk(problem.get("detail"))
            said = next(iter(problem.get("errors") or []), None)
            if said is None or "state" not in said:
                raise Refused(str(problem.get("detail") or f"The server answered {answer.status_code}."))
        return Uploaded(name, said.get("frame_id"), said["state"], said["created"], said.get("detail"))

    def finalise(self, mission_id: str) -> None:
        """Asks for the final map."""
        self._json("POST", f"/missions/{mission_id}/finalise")

    def survey(self, mission_id: str, content: str | None, use: Sequence[str] = ()) -> None:
        """Sends the surveyed points (None: takes them back); those to `use` hold the map in place."""
        url = f"/missions/{mission_id}/checkpoints"
        if content is None:
            self._good(self._ask("DELETE", url))
        else:
            self._json("PUT", url, content=content.encode(), params={"use": list(use)})

    def want(self, mission_id: str, name: str, crs: str | None = None, retry: bool = False) -> int:
        """Has one export made, if it is not there yet; the answer's status. `retry`: also if that failed."""
        url = _export_url(mission_id, name, crs, retry)
        answer = self._ask("GET", url, headers={"Range": "bytes=0-0"})
        return 409 if answer.status_code == 409 else self._good(answer).status_code

    def failure(self, mission_id: str, name: str, crs: str | None = None) -> str:
        """Why an export that cannot be made cannot."""
        return str(_problem(self._ask("GET", _export_url(mission_id, name, crs))).get("detail") or "")

    def download(
        self, mission_id: str, name: str, path: Path, wait: Callable[[], None], crs: str | None = None
    ) -> bool:
        """Fetches one export into `path`, calling `wait` while it is made; False when it cannot be made.

        `crs`: of the mosaic, where not the mission's UTM zone.
        """
        url, part = _export_url(mission_id, name, crs), path.with_name(path.name + ".part")
        while (status := self.want(mission_id, name, crs)) != 409:
            # By the time that the file is asked for a map that grows may have outgrown it.
            if status != 202 and self._good(self._fetch(url, part)).status_code != 202:
                part.replace(path)
                return True
            wait()
            time.sleep(0.25)
        return False

    def _fetch(self, url: str, path: Path) -> httpx.Response:
        return self._stubbornly(lambda: self._stream(url, path))

    def _stream(self, url: str, path: Path) -> httpx.Response:
        with self._http.stream("GET", url) as answer:
            if answer.is_success:
                with path.open("wb") as out:
                    for chunk in answer.iter_bytes(1 << 20):
                        out.write(chunk)
            else:
                answer.read()
        return answer

    def _json(self, method: str, url: str, **more: Any) -> dict[str, Any]:
        document: dict[str, Any] = self._good(self._ask(method, url, **more)).json()
        return document

    def _good(self, answer: httpx.Response) -> httpx.Response:
        if not answer.is_success:
            said = _problem(answer).get("detail") or f"The server answered {answer.status_code}."
            raise Refused(str(said))
        return answer

    def _ask(self, method: str, url: str, **more: Any) -> httpx.Response:
        return self._stubbornly(lambda: self._http.request(method, url, **more))

    def _stubbornly(self, ask: Callable[[], httpx.Response], retry_s: float | None = None) -> httpx.Response:
        """A network that breaks and a server that restarts are normal: only time makes us give up."""
        began, pause_s = time.monotonic(), _FIRST_PAUSE_S
        while True:
            give_up_at = began + (self._retry_s if retry_s is None else retry_s)
            try:
                answer = ask()
                give_up_at = min(give_up_at, began + _PATIENCE_S.get(answer.status_code, math.inf))
                if answer.status_code not in _AGAIN or time.monotonic() + pause_s > give_up_at:
                    return answer
                trouble = str(_problem(answer).get("detail") or f"it answers {answer.status_code}")
            except httpx.TransportError as error:
                if time.monotonic() + pause_s > give_up_at:
                    raise ServerAway(f"The server {self.url} does not answer ({error}).") from error
                trouble = str(error)
            self._complain(trouble, give_up_at)
            time.sleep(pause_s)
            pause_s = min(2 * pause_s, _LONGEST_PAUSE_S)

    def _complain(self, trouble: str, give_up_at: float) -> None:
        now = time.monotonic()
        if now > self._said_at + _SAY_EVERY_S:
            self._said_at = now
            self._say(f"{self.url}: {trouble.rstrip('.')}. Trying again for {give_up_at - now:.0f} s more …")


def _export_url(mission_id: str, name: str, crs: str | None, retry: bool = False) -> str:
    asked = ([f"crs={crs}"] if crs else []) + (["retry=true"] if retry else [])
    return f"/missions/{mission_id}/exports/{name}" + ("?" + "&".join(asked) if asked else "")


def _problem(answer: httpx.Response) -> Mapping[str, Any]:
    try:
        body = answer.json()
    except ValueError:
        return {}
    return body if isinstance(body, dict) else {}
