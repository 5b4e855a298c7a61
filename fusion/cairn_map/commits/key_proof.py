"""Proof that a robot holds its keys, for a registration: signatures over a challenge of the server.

    server -> robot    a challenge: random, good for a minute
    robot -> server    Cairn-Proof: mole.1f2e3d4c5b6a7988 CHALLENGE KEY.MARK,KEY.MARK

What is signed names the map, the author and a challenge of this minute, so that a proof is worth nothing for another
robot or later, and only at the server whose challenge it answers. It does not name that server: a hostile server can
show a robot the challenge of another one, and hand the proof on (docs/security.md, Not defended).
"""

import re
from dataclasses import dataclass
from typing import Self

from cairn_map.commits.ids import Author, author_from_text
from cairn_map.commits.signature import TEXT_MAX, Signature, signatures_from_text, signatures_to_text
from cairn_map.errors import BadInputError

PROOF_TEXT_MAX = TEXT_MAX + 256
CHALLENGE = re.compile(r"[0-9a-f]{16,128}")


@dataclass(frozen=True, slots=True)
class KeyProof:
    """Proof as it is sent, not checked yet."""

    author: Author
    """Robot and incarnation that ask to be registered."""
    challenge: str
    signatures: tuple[Signature, ...]

    def to_text(self) -> str:
        """Text of the header `Cairn-Proof`."""
        return f"{self.author} {self.challenge} {signatures_to_text(self.signatures)}"

    @classmethod
    def from_text(cls, text: str) -> Self:
        """Proof of a header's text; the mirror of `to_text`.

        Raises:
            BadInputError: kind `bad_signature`, `bad_name` or `bad_id`: it is malformed.
        """
        parts = text[: PROOF_TEXT_MAX + 1].split(" ")
        if len(text) > PROOF_TEXT_MAX or len(parts) != 3 or not CHALLENGE.fullmatch(parts[1]):
            raise BadInputError("bad_signature", "a proof is written ROBOT.INCARNATION CHALLENGE KEY.MARK,...")
        return cls(author_from_text(parts[0]), parts[1], signatures_from_text(parts[2]))


def proof_bytes(map_name: str, author: Author, challenge: str) -> bytes:
    """Message that each key signs."""
    return b"cairn-registration-1\0" + "\0".join((map_name, str(author), challenge)).encode()
