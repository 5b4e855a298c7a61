"""Routes of the operator's console: the page and its files, held in memory as they were built, each plain and gzipped.

server/console/ has the sources. Names of assets carry a digest of what they hold, so browsers keep them for ever; only
the page itself is asked for again.
"""

import gzip
import hashlib
from dataclasses import dataclass
from functools import cached_property
from importlib.resources import files
from pathlib import Path
from typing import Annotated

from fastapi import APIRouter, Header, Request, Response

from cairn_map.errors import NotFoundError
from cairn_server.http.routes.documentation import answers
from cairn_server.views.cell_views import is_same

STATIC = Path(str(files("cairn_server"))) / "static"
PAGE = "index.html"
MEDIA_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".svg": "image/svg+xml",
}
NOT_BUILT = """<!doctype html><html lang="en"><meta charset="utf-8"><title>cairn</title><h1>cairn map server</h1>
<p>It runs, but it was installed without this page: where npm's registry can be reached, run <code>make console</code>
in the folder with cairn's sources, install from there again, and start the server again.</p>
<p>All else is there: <a href="maps">maps</a>, <a href="docs">routes</a>; <code>cairn map ls</code> lists the maps in a
terminal.</p></html>"""

SECURITY = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; worker-src 'self'; connect-src 'self'; "
        "img-src 'self' blob: data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
}
FOR_EVER = "public, max-age=31536000, immutable"


@dataclass(frozen=True, slots=True)
class ConsoleFile:
    """One file of the page."""

    plain: bytes
    gzipped: bytes
    media_type: str
    etag: str


class ConsoleFiles:
    """The page and its assets by name, read when the first browser comes; unbuilt: a page that says how to build it."""

    def __init__(self, folder: Path = STATIC) -> None:
        self._folder = folder

    @cached_property
    def page(self) -> ConsoleFile:
        """The page itself."""
        path = self._folder / PAGE
        return _file(path.read_bytes() if path.exists() else NOT_BUILT.encode(), ".html")

    @cached_property
    def _assets(self) -> dict[str, ConsoleFile]:
        paths = [path for path in (self._folder / "assets").glob("*") if path.suffix in MEDIA_TYPES]
        return {path.name: _file(path.read_bytes(), path.suffix) for path in paths}

    def asset(self, name: str) -> ConsoleFile:
        """A script, style or picture of the page.

        Raises:
            NotFoundError: kind `no_route`: the page has no such file; a page of an older version asks, perhaps.
        """
        if name not in self._assets:
            raise NotFoundError("no_route", f"the console has no file {name[:64]}; reload the page")
        return self._assets[name]


def _file(data: bytes, suffix: str) -> ConsoleFile:
    etag = f'"{hashlib.sha256(data).hexdigest()[:32]}"'
    return ConsoleFile(data, gzip.compress(data, 9, mtime=0), MEDIA_TYPES[suffix], etag)


router = APIRouter()
Accepted = Annotated[str, Header(alias="Accept-Encoding")]
Held = Annotated[str | None, Header()]


def files_of(request: Request) -> ConsoleFiles:
    """The app's files."""
    found: ConsoleFiles = request.app.state.console_files
    return found


@router.get("/", response_class=Response, responses=answers({200: ("text/html",), 304: ()}))
def page(request: Request, accept_encoding: Accepted = "", if_none_match: Held = None) -> Response:
    """The operator's console, for browsers."""
    return _answer(files_of(request).page, accept_encoding, if_none_match, kept="no-cache")


@router.get(
    "/assets/{file}",
    response_class=Response,
    responses=answers({200: ("text/javascript", "text/css", "image/svg+xml"), 304: ()}),
)
def asset(file: str, request: Request, accept_encoding: Accepted = "", if_none_match: Held = None) -> Response:
    """A script or style of the console; its name changes with what it holds."""
    return _answer(files_of(request).asset(file), accept_encoding, if_none_match, kept=FOR_EVER)


def _answer(file: ConsoleFile, accept_encoding: str, if_none_match: str | None, *, kept: str) -> Response:
    headers = {"ETag": file.etag, "Cache-Control": kept, "Vary": "Accept-Encoding", **SECURITY}
    if is_same(file.etag, if_none_match):
        return Response(status_code=304, headers=headers)
    if "gzip" in accept_encoding:
        headers["Content-Encoding"] = "gzip"
        return Response(file.gzipped, media_type=file.media_type, headers=headers)
    return Response(file.plain, media_type=file.media_type, headers=headers)
