"""Signatures of commits, which prove their authors: Ed25519 over the map's name and the commit's SHA-256.

    key -> incarnation = first 16 hex digits of SHA-256("cairn-key-1" | key)

A robot draws a key and takes the incarnation that follows from it, so that any server knows whose signature a commit of
`robot.incarnation` needs without having met that robot. The signature travels next to the bytes, never in them.
"""

import hashlib
import secrets
from collections.abc import Collection
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple, Self

from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

from cairn_map.commits.ids import Author, Incarnation
from cairn_map.errors import BadInputError

KEY_BYTES, MARK_BYTES = 32, 64
SIGNATURES_MAX = 16
"""Signatures of one commit: its author's, and those of the robot's older incarnations whose commits it retracts."""
SMALL_ORDER = frozenset(
    bytes.fromhex(text)
    for text in (
        "00" * 32,
        "01" + "00" * 31,
        "26e8958fc2b227b045c3f489f2ef98f0d5dfac05d3c63339b13802886d53fc05",
        "c7176a703d4dd84fba3c0b760d10670f2a2053fa2c39ccc64ec7fd7792ac037a",
        "ec" + "ff" * 30 + "7f",
        "ed" + "ff" * 30 + "7f",
        "ee" + "ff" * 30 + "7f",
    )
)
"""Encodings, without the sign, of points whose order divides eight: keys for which anyone can make a signature."""
TEXT_MAX = SIGNATURES_MAX * (2 * (KEY_BYTES + MARK_BYTES) + 2)


class Signature(NamedTuple):
    """One signature on a commit; in text `KEY.MARK`, both in hex."""

    key: bytes
    """(32 bytes) public key."""
    mark: bytes
    """(64 bytes) the Ed25519 signature itself."""

    def __str__(self) -> str:
        return f"{self.key.hex()}.{self.mark.hex()}"


@dataclass(frozen=True)
class SigningKey:
    """Secret key that signs commits."""

    seed: bytes = field(repr=False)
    """(32 bytes) the Ed25519 seed."""

    @classmethod
    def drawn(cls) -> Self:
        """A random key."""
        return cls(bytes.fromhex(secrets.token_hex(KEY_BYTES)))

    @cached_property
    def public_key(self) -> bytes:
        """(32 bytes) public key, by which its signatures are checked."""
        return self._secret.public_key().public_bytes_raw()

    @property
    def incarnation(self) -> Incarnation:
        """Incarnation of the robot that signs with this key."""
        return incarnation_of(self.public_key)

    def sign(self, map_name: str, sha: bytes) -> Signature:
        """A signature on the commit of this SHA-256, for the map of this name and no other."""
        return self.sign_bytes(signed_bytes(map_name, sha))

    def sign_bytes(self, message: bytes) -> Signature:
        """A signature on any message, which is to name its purpose first, so that it counts for no other."""
        return Signature(self.public_key, self._secret.sign(message))

    @cached_property
    def _secret(self) -> Ed25519PrivateKey:
        return Ed25519PrivateKey.from_private_bytes(self.seed)


def incarnation_of(key: bytes) -> Incarnation:
    """The incarnation of a robot that signs with this public key."""
    return Incarnation(hashlib.sha256(b"cairn-key-1" + key).hexdigest()[:16])


def signed_bytes(map_name: str, sha: bytes) -> bytes:
    """Message that is signed; the SHA-256 covers the id, the geometry and all evidence."""
    return b"cairn-signed-commit-1\0" + map_name.encode() + b"\0" + sha


def check_signatures(signatures: Collection[Signature], map_name: str, sha: bytes) -> None:
    """Refuse a commit with an invalid signature.

    Raises:
        BadInputError: kind `bad_signature`.
    """
    for signature in signatures:
        if not are_valid([signature], signed_bytes(map_name, sha)):
            raise BadInputError(
                "bad_signature",
                f"the signature of key {signature.key.hex()[:16]}... is not one of this commit on map {map_name}: "
                "somebody changed it on its way, or it was made for another map",
            )


def are_valid(signatures: Collection[Signature], message: bytes) -> bool:
    """True if all signatures are ones of a message."""
    try:
        for signature in signatures:
            if signature.key[:-1] + bytes([signature.key[-1] & 0x7F]) in SMALL_ORDER:
                return False
            Ed25519PublicKey.from_public_bytes(signature.key).verify(signature.mark, message)
    except (InvalidSignature, ValueError):
        return False
    return True


def speaks_for(signatures: Collection[Signature], author: Author) -> bool:
    """True if one of the signatures, which are valid, is by the author's own key."""
    return any(incarnation_of(signature.key) == author.incarnation for signature in signatures)


def signatures_to_text(signatures: Collection[Signature]) -> str:
    """Text of the header `Cairn-Signature`."""
    return ",".join(map(str, signatures))


def signatures_from_text(text: str) -> tuple[Signature, ...]:
    """Signatures of a header's text, not checked yet; the mirror of `signatures_to_text`.

    Raises:
        BadInputError: kind `bad_signature`: it is malformed, or there are too many.
    """
    try:
        parts = [part.split(".") for part in text[: TEXT_MAX + 1].split(",")]
        found = tuple(Signature(bytes.fromhex(key), bytes.fromhex(mark)) for key, mark in parts)
        if len(text) > TEXT_MAX or any((len(key), len(mark)) != (KEY_BYTES, MARK_BYTES) for key, mark in found):
            raise ValueError("too long, or not of 32 and 64 bytes")
        if signatures_to_text(found) != text:
            raise ValueError("not in lower-case hex")
    except ValueError as exc:
        raise BadInputError(
            "bad_signature", f"signatures are written KEY.MARK in hex, separated by commas (at most {SIGNATURES_MAX})"
        ) from exc
    return found
