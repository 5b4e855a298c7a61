"""Challenges for proofs of robots' keys, and the check of a proof.

A challenge is the time of its making and a code over it by a secret, so that none is kept: it is good for a minute. The
secret is this process's, and gone with it, or that of a store on which several servers work.
"""

import hashlib
import hmac
import secrets
import time
from collections.abc import Callable

from cairn_map.commits.ids import Incarnation
from cairn_map.commits.key_proof import KeyProof, proof_bytes
from cairn_map.commits.signature import are_valid, incarnation_of
from cairn_map.errors import BadInputError

LIFETIME_S = 60.0
TIME_DIGITS = 16


class Challenges:
    """Challenges by one secret; called from many threads."""

    def __init__(self, *, secret: bytes | None = None, steady_s: Callable[[], float] = time.monotonic) -> None:
        """Servers that take each other's challenges share `secret` and clock; without it, it is random."""
        self._secret = secret or secrets.token_bytes(32)
        self._steady_s = steady_s

    def new(self) -> str:
        """A challenge, in hex."""
        made = f"{round(self._steady_s() * 1000):0{TIME_DIGITS}x}"
        return made + self._code(made)

    def signers(self, proof: KeyProof, *, map_name: str, own: frozenset[str]) -> frozenset[Incarnation]:
        """Incarnations whose keys a proof shows; `own`: origins of this server, as in `access.own_names`.

        Raises:
            BadInputError: kind `other_origin`: the proof was made for another server.
            BadInputError: kind `bad_signature`: the challenge is none of this server's or too old, or a signature is
                not one of it.
        """
        check_origin(proof, own=own)
        made, code = proof.challenge[:TIME_DIGITS], proof.challenge[TIME_DIGITS:]
        if not hmac.compare_digest(code, self._code(made)):
            raise BadInputError("bad_signature", "the proof answers no challenge of this server; ask for a new one")
        if self._steady_s() - int(made, 16) / 1000 > LIFETIME_S:
            raise BadInputError("bad_signature", f"the challenge is older than {LIFETIME_S:.0f} s; ask for a new one")
        if not are_valid(proof.signatures, proof_bytes(proof.origin, map_name, proof.author, proof.challenge)):
            raise BadInputError("bad_signature", f"a signature of the proof is not one for {proof.author} on this map")
        return frozenset(incarnation_of(signature.key) for signature in proof.signatures)

    def _code(self, made: str) -> str:
        return hmac.new(self._secret, made.encode(), hashlib.sha256).hexdigest()


def check_origin(proof: KeyProof, *, own: frozenset[str]) -> None:
    """Refuse a proof that was made for another server.

    Raises:
        BadInputError: kind `other_origin`.
    """
    if proof.origin not in own:
        raise BadInputError(
            "other_origin",
            f"this proof was made for {proof.origin}, and this server answers to {', '.join(sorted(own))}. If "
            f"{proof.origin} is one of its names, its administrator starts it with --public-url {proof.origin}",
        )
