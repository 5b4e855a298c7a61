"""Proof that a robot holds its keys, for a registration: signatures over a challenge of the server.

    server -> robot    a challenge: random, good for a minute
    robot -> server    Cairn-Proof: mole.1f2e3d4c5b6a7988 CHALLENGE http://base:8750 KEY.MARK,KEY.MARK

What is signed names the server that the robot asked (scheme, host and port of its URL), the map, the author and a
challenge of this minute, so that a proof is worth nothing for another robot, later, or at another server: one that
shows a robot another's challenge gets a proof that names itself.
"""

import re
from dataclasses import dataclass
from typing import Self

from cairn_map.commits.ids import Author, author_from_text
from cairn_map.commits.signature import TEXT_MAX, Signature, signatures_from_text, signatures_to_text
from cairn_map.errors import BadInputError

PROOF_TEXT_MAX = TEXT_MAX + 640
CHALLENGE = re.compile(r"[0-9a-f]{16,128}")
ORIGIN = re.compile(r"https?://[!-.0-~]{1,300}:[0-9]{1,5}")


@dataclass(frozen=True, slots=True)
class KeyProof:
    """Proof as it is sent, not checked yet."""

    author: Author
    """Robot and incarnation that ask to be registered."""
    challenge: str
    origin: str
    """Server that the robot asked, as its URL names it: `http://base:8750`."""
    signatures: tuple[Signature, ...]

    def to_text(self) -> str:
        """Text of the header `Cairn-Proof`."""
        return f"{self.author} {self.challenge} {self.origin} {signatures_to_text(self.signatures)}"

    @classmethod
    def from_text(cls, text: str) -> Self:
        """Proof of a header's text; the mirror of `to_text`.

        Raises:
            BadInputError: kind `bad_signature`, `bad_name` or `bad_id`: it is malformed.
        """
        parts = text[: PROOF_TEXT_MAX + 1].split(" ")
        if len(parts) == 3:
            raise BadInputError("bad_signature", "the proof names no server: the robot's cairn is too old; update it")
        if len(text) > PROOF_TEXT_MAX or len(parts) != 4 or not CHALLENGE.fullmatch(parts[1]):
            raise BadInputError("bad_signature", "a proof is written ROBOT.INCARNATION CHALLENGE ORIGIN KEY.MARK,...")
        if not ORIGIN.fullmatch(parts[2]):
            raise BadInputError("bad_signature", "the server of a proof is written http://HOST:PORT")
        return cls(author_from_text(parts[0]), parts[1], parts[2], signatures_from_text(parts[3]))


def proof_bytes(origin: str, map_name: str, author: Author, challenge: str) -> bytes:
    """Message that each key signs."""
    return b"cairn-registration-2\0" + "\0".join((origin, map_name, str(author), challenge)).encode()
