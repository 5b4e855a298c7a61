"""Large commits go in parts: a link that breaks every half minute carries them all the same. No I/O.

commit of 300 kB:   how much is there?  -- 128 kB -->  64 kB -->  64 kB -->  44 kB: checked, kept, acknowledged
"""

import hashlib
from dataclasses import dataclass, replace

from cairn_client.asks import Conversation, GetUpload, Push, PutPart
from cairn_map.errors import ConflictError, UnreachableError


@dataclass(frozen=True, slots=True)
class Parts:
    """How large."""

    above_bytes: int = 1 << 18
    """Commits up to this go whole."""
    part_bytes: int = 1 << 16
    """64 kB are 8 s at 64 kbit/s: an answer is waited for 30 s."""

    def after_a_cut(self) -> "Parts":
        """Where a push broke, smaller commits go in parts, too: whole, at 50 kbit/s, 200 kB would never be answered."""
        return replace(self, above_bytes=self.part_bytes)


PARTS = Parts()


def push_whole_or_in_parts(push: Push, parts: Parts) -> Conversation[None]:
    """Push a commit; when this ends the server has it for good.

    Raises:
        CairnError: as `Push`; what came of a part stays there for the next try.
    """
    commit = push.commit
    if push.seal is not None or len(commit.data) <= parts.above_bytes:
        yield from push
        return
    digest = hashlib.sha256(commit.data).hexdigest()
    found = yield from GetUpload(commit.id, digest)
    tries = 2 * (len(commit.data) // parts.part_bytes + 2)
    while found.sha is None:
        if not tries:
            raise UnreachableError("no_end", f"commit {commit.id} does not come to its end, part by part", 30.0)
        tries -= 1
        part = commit.data[found.size_bytes : found.size_bytes + parts.part_bytes]
        found = yield from PutPart(commit.id, digest, len(commit.data), found.size_bytes, part, push.signatures)
    if found.sha != commit.sha.hex():
        raise ConflictError("id_taken", f"the server has other bytes under the id {commit.id}")
