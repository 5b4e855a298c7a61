"""Routes of the operator's console: the page and its files. Nothing is decided here."""

from typing import Annotated

from fastapi import APIRouter, Header, Request, Response

from cairn_server.http.routes.console_files import ConsoleFile, ConsoleFiles
from cairn_server.views.cell_view import is_same

SECURITY = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; worker-src 'self'; connect-src 'self'; "
        "img-src 'self' blob: data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
}
FOR_EVER = "public, max-age=31536000, immutable"

router = APIRouter()
Accepted = Annotated[str, Header(alias="Accept-Encoding")]
Held = Annotated[str | None, Header()]


def files_of(request: Request) -> ConsoleFiles:
    """The app's files, read when the first browser comes."""
    state = request.app.state
    if not hasattr(state, "console_files"):
        state.console_files = ConsoleFiles()
    files: ConsoleFiles = state.console_files
    return files


@router.get("/", response_class=Response)
def page(request: Request, accept_encoding: Accepted = "", if_none_match: Held = None) -> Response:
    """The operator's console, for browsers."""
    return _answer(files_of(request).page, accept_encoding, if_none_match, kept="no-cache")


@router.get("/assets/{file}", response_class=Response)
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
