"""Cursors: positions in a server's log that prove its history, `(log_id, seq, chain)`, always compared as a whole.

    chain[0] = H(log_id, geometry)      chain[s] = H(chain[s - 1], kind, id, sha)

H is SHA-256, cut to 16 bytes (FORMAT.md section 9). A server that was restored from an older backup, and then folded
other commits, has another chain at the same seq; so it recognises a cursor from before the restore.
"""

import hashlib
from dataclasses import dataclass

from cairn_map.commits.ids import CommitId
from cairn_map.errors import BadInputError

CHAIN_BYTES = 16
ENTRY_FOLD = b"+"
ENTRY_UNFOLD = b"-"


@dataclass(frozen=True, slots=True)
class Cursor:
    """State of one server's map: everything folded up to and including `seq`."""

    log_id: bytes
    seq: int
    chain: bytes

    def __post_init__(self) -> None:
        if len(self.log_id) != 16 or len(self.chain) != CHAIN_BYTES or not 0 <= self.seq < 1 << 63:
            raise BadInputError("bad_cursor", "a cursor is 16 bytes log id, a sequence number, 16 bytes chain")

    def __str__(self) -> str:
        return f"{self.log_id.hex()}.{self.seq}.{self.chain.hex()}"


def cursor_from_text(text: str) -> Cursor:
    """Cursor of a text `log_id.seq.chain` (hex, decimal, hex).

    Raises:
        BadInputError: the text is not of that form.
    """
    parts = text.split(".")
    try:
        if len(text) > 128 or len(parts) != 3 or not parts[1].isascii() or not parts[1].isdigit():
            raise ValueError
        cursor = Cursor(bytes.fromhex(parts[0]), int(parts[1]), bytes.fromhex(parts[2]))
        if str(cursor) != text:  # bytes.fromhex skips spaces and takes capitals; a cursor has one text only
            raise ValueError
        return cursor
    except (ValueError, BadInputError):
        raise BadInputError("bad_cursor", f"a cursor is written log_id.seq.chain, got {text[:128]!r}") from None


def first_chain(log_id: bytes, layer_digest: bytes) -> bytes:
    """Chain of an empty log; without epochs the digest of the map's layer is that of its geometry."""
    return hashlib.sha256(b"cairn-chain-0" + log_id + layer_digest).digest()[:CHAIN_BYTES]


def next_chain(chain: bytes, kind: bytes, commit: CommitId, sha: bytes) -> bytes:
    """Chain after one more entry: a commit folded (`ENTRY_FOLD`) or taken out (`ENTRY_UNFOLD`)."""
    return hashlib.sha256(chain + kind + str(commit).encode() + b"\0" + sha).digest()[:CHAIN_BYTES]
