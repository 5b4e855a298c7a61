"""Errors as RFC 9457 problems: `application/problem+json` with our stable `kind`."""

import logging
from collections.abc import Callable
from typing import Any

from fastapi import Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

from cairn_map.errors import (
    BadInputError,
    CairnError,
    ConflictError,
    DamagedDataError,
    DeniedError,
    NotFoundError,
    UnreachableError,
    complaint_text,
)
from cairn_map.wire.messages import Problem

log = logging.getLogger(__name__)

MEDIA_TYPE = "application/problem+json"
STATUS_OF_KIND = {
    "no_token": 401,
    "bad_token": 401,
    "unconfirmed_token": 401,
    "bad_ticket": 401,
    "too_large": 413,
    "other_log": 410,
    "gone": 410,
    "quota": 429,
    "bad_clock": 425,
    "damaged_store": 500,
    "disk_full": 507,
    "bad_range": 416,
    "upgrade_required": 426,
    "too_many_streams": 429,
    "too_many_views": 429,
    "too_many_tickets": 429,
}
KIND_OF_STATUS = {404: "no_route", 405: "no_method"}
"""Kinds of the framework's own refusals."""
DETAIL_CHARACTERS_MAX = 1000
STATUS_OF_FAMILY = (
    (DeniedError, 403),
    (BadInputError, 400),
    (NotFoundError, 404),
    (ConflictError, 409),
    (DamagedDataError, 400),
    (UnreachableError, 503),
)


def status_of(error: CairnError) -> int:
    """The HTTP status of an error."""
    if error.kind in STATUS_OF_KIND:
        return STATUS_OF_KIND[error.kind]
    return next((status for family, status in STATUS_OF_FAMILY if isinstance(error, family)), 500)


def answer_to(exc: CairnError) -> JSONResponse:
    """An error as a problem."""
    headers: dict[str, str] = {}
    if isinstance(exc, UnreachableError) and exc.retry_after_s is not None:
        headers["Retry-After"] = f"{exc.retry_after_s:.0f}"
    if status_of(exc) == 401:
        headers["WWW-Authenticate"] = "Bearer"
    if status_of(exc) == 426:
        headers |= {"Upgrade": "websocket", "Connection": "Upgrade"}
    return _problem(status_of(exc), exc.kind, exc.message, headers)


def _of_cairn(request: Request, exc: CairnError) -> JSONResponse:
    return answer_to(exc)


def _of_validation(request: Request, exc: RequestValidationError) -> JSONResponse:
    first = exc.errors()[0]
    where = ".".join(str(part) for part in first["loc"])
    return _problem(422, "bad_message", f"{where}: {complaint_text(first['msg'])}", {})


def _of_http(request: Request, exc: HTTPException) -> JSONResponse:
    kind = KIND_OF_STATUS.get(exc.status_code, "http")
    return _problem(exc.status_code, kind, str(exc.detail), dict(exc.headers or {}))


def _of_cut_link(request: Request, exc: ClientDisconnect) -> JSONResponse:
    log.info("%s %s: the link was cut before the body was whole", request.method, request.url.path[:200])
    return _problem(400, "cut_off", "the body did not come whole", {})


def _of_bug(request: Request, exc: Exception) -> JSONResponse:
    log.error("%s %s failed", request.method, request.url.path, exc_info=exc)
    return _problem(500, "internal", "the server failed in a way that it did not expect; its log says more", {})


def _problem(status: int, kind: str, detail: str, headers: dict[str, str]) -> JSONResponse:
    # A complaint may quote the request: half a surrogate pair, or megabytes.
    detail = detail[:DETAIL_CHARACTERS_MAX].encode(errors="replace").decode()
    problem = Problem(title=kind.replace("_", " "), status=status, detail=detail, kind=kind)
    return JSONResponse(problem.model_dump(), status, headers, media_type=MEDIA_TYPE)


PROBLEM_HANDLERS: dict[int | type[Exception], Callable[..., Any]] = {
    CairnError: _of_cairn,
    RequestValidationError: _of_validation,
    HTTPException: _of_http,
    ClientDisconnect: _of_cut_link,
    Exception: _of_bug,
}
"""Handlers that make every error of the app a problem."""
