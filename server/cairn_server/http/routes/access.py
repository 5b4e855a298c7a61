"""Routes of tokens and of the audit log. Nothing is decided here."""

from typing import Annotated

from fastapi import APIRouter, Depends, Query

from cairn_map.wire.access_messages import AuditEntry, CreateToken, NewSecret, TokenInfo
from cairn_server.access.auth import Caller
from cairn_server.access.tokens import create_token, list_tokens, revoke_token, rotate_token
from cairn_server.http.routes.callers import ADMIN, Operations, admin

AUDIT_PAGE_MAX = 1000

router = APIRouter()
Admin = Annotated[Caller, Depends(admin)]


@router.get("/tokens", dependencies=ADMIN)
def get_tokens(service: Operations) -> list[TokenInfo]:
    """All tokens, without their secrets."""
    return list_tokens(service.store)


@router.put("/tokens/{token}", status_code=201)
def put_token(token: str, body: CreateToken, service: Operations, caller: Admin) -> NewSecret:
    """Create a token; its secret is shown this once."""
    return create_token(service.store, token, body, by=caller)


@router.post("/tokens/{token}/rotate")
def rotate(token: str, service: Operations, caller: Admin) -> NewSecret:
    """Another secret for a token; the old one is worth nothing at once."""
    return rotate_token(service.store, token, by=caller)


@router.delete("/tokens/{token}", status_code=204)
def delete_token(token: str, service: Operations, caller: Admin) -> None:
    """Revoke a token."""
    revoke_token(service.store, token, by=caller)


@router.get("/audit", dependencies=ADMIN)
def get_audit(
    service: Operations,
    after: Annotated[int, Query(ge=0, lt=1 << 63)] = 0,
    limit: Annotated[int, Query(ge=1, le=AUDIT_PAGE_MAX)] = 100,
) -> list[AuditEntry]:
    """Lines of the audit log, oldest first."""
    return service.store.audit_log.page(after=after, limit=limit)
