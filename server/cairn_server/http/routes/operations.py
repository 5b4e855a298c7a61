"""Routes for operators of the server: probes and metrics, tokens and the audit log."""

from typing import Annotated

from fastapi import APIRouter, Depends, Query
from fastapi.responses import PlainTextResponse

from cairn_map.epochs.moment import TimeText, time_from_text
from cairn_map.errors import UnreachableError
from cairn_map.wire.access_messages import AuditEntry, CreateToken, NewSecret, SiteInfo, TokenInfo, TrustedTime
from cairn_server.access.auth import Caller
from cairn_server.access.tokens import confirm_token, create_token, list_tokens, revoke_token, rotate_token
from cairn_server.http.routes.callers import ADMIN, Asking, Operations, Times, admin, reader_somewhere
from cairn_server.http.routes.documentation import json_body, problems
from cairn_server.http.routes.json_bodies import json_of
from cairn_server.metrics import MEDIA_TYPE
from cairn_server.store.store_rows import NUMBER_LIMIT, AuditChoice

AUDIT_PAGE_MAX = 1000
AUDIT_TEXT_MAX = 128

router = APIRouter()
Admin = Annotated[Caller, Depends(admin)]


@router.get("/healthz")
async def healthz(service: Operations) -> dict[str, str]:
    """The process answers, and got no signal to stop."""
    # On the event loop, without a lock or a thread: it says that the server can be reached, and nothing else.
    if service.readiness.is_closing:
        raise UnreachableError("shutting_down", "the server is stopping", retry_after_s=5.0)
    return {"status": "ok"}


def metrics_reader(asker: Asking) -> None:
    """Pass a caller that may read the metrics: an admin, or with `--metrics-open` any client."""
    if not asker.service.settings.metrics_open:
        admin(asker.caller(None))


@router.get("/readyz")
def readyz(service: Operations) -> dict[str, str]:
    """The server can take a push and bring it into the map; else 503 says why not.

    A clock that is not trusted takes no server out of service: what it hands out and takes is less, and right. Nor does
    an upstream server that refuses this one: robots map on here.
    """
    service.readiness.check()
    complaints = [ill for ill in (service.clock.complaint(), service.sync.upstream.complaint()) if ill]
    return {"status": "ready"} | ({"degraded": "; ".join(complaints)} if complaints else {})


@router.get("/metrics", response_class=PlainTextResponse, dependencies=[Depends(metrics_reader)])
def metrics(service: Operations) -> PlainTextResponse:
    """Figures for Prometheus."""
    return PlainTextResponse(service.metrics_text(), media_type=MEDIA_TYPE)


@router.post("/clock", responses=problems(409))
def trust_clock(service: Operations, caller: Admin) -> TrustedTime:
    """Trust the time of day as it is now."""
    return TrustedTime(time_s=service.clock.trust(by=caller.name, client=caller.address))


@router.get("/servers", dependencies=[Depends(reader_somewhere)], response_model_exclude_defaults=True)
def get_servers(service: Operations) -> SiteInfo:
    """Servers of this one's store that are alive."""
    return service.site.info()


@router.get("/tokens", dependencies=ADMIN)
def get_tokens(service: Operations, times: Times) -> list[TokenInfo]:
    """All tokens, without their secrets."""
    return [times(token) for token in list_tokens(service.store)]


@router.put("/tokens/{token}", status_code=201, responses=problems(409), openapi_extra=json_body(CreateToken))
def put_token(
    token: str, service: Operations, caller: Admin, body: Annotated[CreateToken, json_of(CreateToken)]
) -> NewSecret:
    """Create a token; its secret is shown this once."""
    return create_token(service.store, token, body, by=caller)


@router.post("/tokens/{token}/rotate")
def rotate(token: str, service: Operations, caller: Admin) -> NewSecret:
    """Give a token another secret; the old one ends at once."""
    return rotate_token(service.store, token, by=caller)


@router.post("/tokens/{token}/confirm")
def confirm(token: str, service: Operations, caller: Admin) -> TokenInfo:
    """Let a token that a restore brought back count again."""
    return confirm_token(service.store, token, by=caller)


@router.delete("/tokens/{token}", status_code=204)
def delete_token(token: str, service: Operations, caller: Admin) -> None:
    """Revoke a token."""
    revoke_token(service.store, token, by=caller)


@router.get("/audit", dependencies=ADMIN)
def get_audit(
    service: Operations,
    times: Times,
    after: Annotated[int, Query(ge=0, lt=NUMBER_LIMIT)] = 0,
    before: Annotated[int | None, Query(ge=0, lt=NUMBER_LIMIT, description="newest first, those below it")] = None,
    newest: Annotated[bool, Query(description="newest first")] = False,
    limit: Annotated[int, Query(ge=1, le=AUDIT_PAGE_MAX)] = 100,
    who: Annotated[str | None, Query(max_length=AUDIT_TEXT_MAX)] = None,
    what: Annotated[str | None, Query(max_length=AUDIT_TEXT_MAX)] = None,
    about: Annotated[str | None, Query(alias="map", max_length=AUDIT_TEXT_MAX, description="name of a map")] = None,
    since: Annotated[TimeText | None, Query()] = None,
    until: Annotated[TimeText | None, Query()] = None,
) -> list[AuditEntry]:
    """Lines of the audit log, oldest first; with `newest` or `before` newest first."""
    choice = AuditChoice(who=who, what=what, map=about, since_s=_time_s(since), until_s=_time_s(until))
    if newest and before is None:
        before = NUMBER_LIMIT - 1
    page = service.store.audit_log.page(after=after, before=before, limit=limit, choice=choice)
    return [times(line) for line in page]


def _time_s(text: str | None) -> float | None:
    return None if text is None else time_from_text(text)
