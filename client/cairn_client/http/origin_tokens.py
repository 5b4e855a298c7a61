"""Tokens by origin: each secret that a command was given is sent to one server and to no other.

    OriginTokens.of(url)     the token for a URL's server; None: it has none, and nothing is sent
    --token TOKEN            for the server of the command's first URL
    --token ORIGIN=TOKEN     for the server at ORIGIN, such as http://base:8750; may be repeated

An origin is scheme, host and port, as in RFC 6454.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Self

from cairn_map.errors import DeniedError
from cairn_map.wire.origins import origin_of

NAMED = re.compile(r"(https?://[^\s=/]+)/?=(\S+)")
"""`ORIGIN=TOKEN`."""


@dataclass(frozen=True, slots=True)
class OriginTokens:
    """Tokens of servers, by origin, and one that is not bound to a server yet."""

    by_origin: Mapping[str, str] = field(default_factory=dict[str, str], repr=False)
    unbound: str | None = field(default=None, repr=False)

    def with_text(self, text: str) -> Self:
        """These tokens and those of a text, which come first: `TOKEN` or `ORIGIN=TOKEN`, separated by spaces."""
        by_origin, unbound = dict(self.by_origin), self.unbound
        for part in text.split():
            named = NAMED.fullmatch(part)
            if named:
                by_origin[origin_of(named[1])] = named[2]
            else:
                unbound = part
        return type(self)(by_origin, unbound)

    def bound_to(self, url: str) -> Self:
        """These tokens, where the unbound one counts for the server of this URL alone."""
        if self.unbound is None:
            return self
        return type(self)({origin_of(url): self.unbound, **self.by_origin})

    def with_named_of(self, others: "OriginTokens") -> Self:
        """These tokens, and after them those of others that are bound to a server."""
        return type(self)({**others.by_origin, **self.by_origin}, self.unbound)

    def of(self, url: str) -> str | None:
        """Token for the server of a URL; the unbound one counts for it."""
        return self.bound_to(url).by_origin.get(origin_of(url))


NO_TOKENS = OriginTokens()


def without_token(url: str, said: str) -> DeniedError:
    """Error of a server that wants a token, and for which none was given."""
    origin = origin_of(url)
    return DeniedError(
        "no_token",
        f"there is no token for {origin}, and it wants one; give it with --token {origin}=TOKEN (or in CAIRN_TOKEN); "
        f"a token of another server is never sent there. The server said: {said}",
    )
