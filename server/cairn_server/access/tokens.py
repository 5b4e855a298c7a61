"""Administration of tokens: create, rotate, revoke, list; each change is in the audit log before it is answered."""

import time

from cairn_map.commits.ids import robot_name
from cairn_map.errors import BadInputError
from cairn_map.wire.access_messages import CreateToken, NewSecret, TokenInfo
from cairn_server.access.auth import RESERVED_TOKEN_NAMES, Caller, check_robot_name, new_token, token_hash
from cairn_server.store.store import Store
from cairn_server.store.store_rows import Token


def create_token(store: Store, name: str, request: CreateToken, *, by: Caller) -> NewSecret:
    """Create a token of this name.

    Raises:
        BadInputError: kind `bad_name` or `reserved_name`.
        ConflictError: kind `token_exists`.
        NotFoundError: kind `no_map`.
    """
    if robot_name(name) in RESERVED_TOKEN_NAMES:
        raise BadInputError("reserved_name", f"the audit log means something else by {name}; take another name")
    if request.robot is not None:
        check_robot_name(request.robot)
    now_s = time.time()
    token = Token(
        name=name,
        role=request.role,
        map_number=store.map(request.map).number if request.map else None,
        map_name=request.map,
        robot=request.robot,
        created_s=now_s,
        expires_s=now_s + request.lifetime_s if request.lifetime_s else None,
    )
    secret = new_token()
    store.tokens.add(token, token_hash(secret))
    store.audit_log.add(by.name, "create_token", _detail(token, request), client=by.address)
    return NewSecret(token=secret, info=_info(token))


def rotate_token(store: Store, name: str, *, by: Caller) -> NewSecret:
    """Give a token another secret; the old one is invalid at once.

    Raises:
        NotFoundError: kind `no_such_token`.
    """
    secret = new_token()
    token = store.tokens.renew(name, token_hash(secret))
    store.audit_log.add(by.name, "rotate_token", _detail(token), client=by.address)
    return NewSecret(token=secret, info=_info(token))


def revoke_token(store: Store, name: str, *, by: Caller) -> None:
    """End a token.

    Raises:
        NotFoundError: kind `no_such_token`.
    """
    store.tokens.remove(name)
    store.audit_log.add(by.name, "revoke_token", name, client=by.address)


def confirm_token(store: Store, name: str, *, by: Caller) -> TokenInfo:
    """Let a token count again that a restore brought back, unless it was ended meanwhile.

    Raises:
        NotFoundError: kind `no_such_token`.
    """
    token = store.tokens.confirm(name)
    store.audit_log.add(by.name, "confirm_token", _detail(token), client=by.address)
    return _info(token)


def list_tokens(store: Store) -> list[TokenInfo]:
    """All tokens, by name, without their secrets."""
    return [_info(token) for token in store.tokens.all()]


def _detail(token: Token, request: CreateToken | None = None) -> str:
    """Detail of a line of the audit log: of a token of one map it begins with the map's name, as all about a map do."""
    of_map = f"map {token.map_name}: " if token.map_name else ""
    return of_map + token.name + (f": {request.model_dump_json(exclude_none=True)}" if request else "")


def _info(token: Token) -> TokenInfo:
    return TokenInfo(
        name=token.name,
        role=token.role,
        map=token.map_name,
        robot=token.robot,
        created_s=token.created_s,
        expires_s=token.expires_s,
        last_used_s=token.last_used_s,
        confirmed=token.is_confirmed,
    )
