"""Uploads of large commits in parts, so that a link that breaks every half minute carries them too. No I/O.

commit of 300 kB:   how much is there?  -- 128 kB -->  64 kB -->  64 kB -->  44 kB: checked, kept, acknowledged
"""

import hashlib
from dataclasses import dataclass, field, replace
from functools import cached_property

from cairn_client.sync.requests import Conversation, GetUpload, Push, PutPart
from cairn_map.commits.ids import CommitId
from cairn_map.errors import ConflictError, UnreachableError


@dataclass(frozen=True, slots=True)
class Parts:
    """Sizes of the parts of a commit."""

    above_bytes: int = 1 << 18
    """Size up to which a commit goes whole."""
    part_bytes: int = 1 << 16
    """Size of one part: 64 kB are 8 s at 64 kbit/s, and an answer is waited for 30 s."""

    def after_a_cut(self) -> "Parts":
        """Parts for a link on which a push broke: smaller commits go in parts, too.

        Whole, at 50 kbit/s, a commit of 200 kB would never be answered.
        """
        return replace(self, above_bytes=self.part_bytes)


PARTS = Parts()
CAME_IN_PART = "came_in_part"


@dataclass(frozen=True)
class CommitUpload:
    """A commit's bytes on their way."""

    id: CommitId
    data: bytes = field(repr=False)
    signatures: str | None = field(repr=False)
    """Signatures on the commit, as in `Cairn-Signature`."""

    @cached_property
    def digest(self) -> str:
        """SHA-256, hex, by which the server knows that parts belong together."""
        return hashlib.sha256(self.data).hexdigest()


def push_whole_or_in_parts(push: Push, parts: Parts) -> Conversation[None]:
    """Push a commit; when this ends the server has it for good.

    Raises:
        CairnError: as `Push`; what came of a part stays there for the next try.
    """
    commit = push.commit
    if push.seal is not None or len(commit.data) <= parts.above_bytes:
        yield from push
        return
    upload = CommitUpload(commit.id, commit.data, push.signatures)
    found = yield from GetUpload(commit.id, upload.digest)
    kept_sha = found.sha or (yield from push_rest(upload, found.size_bytes, parts))
    if kept_sha != commit.sha.hex():
        raise ConflictError("id_taken", f"the server has other bytes under the id {commit.id}")


def push_rest(upload: CommitUpload, size_bytes: int, parts: Parts) -> Conversation[str]:
    """Push the parts of a commit that are not there yet; SHA-256 in hex of what the server has for good when it ends.

    Args:
        upload: the commit.
        size_bytes: bytes of it that are there.
        parts: sizes of the parts.

    Raises:
        CairnError: as `Push`.
        UnreachableError: kind `came_in_part`: the link broke, but something came, and stays there for the next try.
    """
    first_bytes, whole_bytes = size_bytes, len(upload.data)
    for _ in range(2 * (whole_bytes // parts.part_bytes + 2)):
        part = upload.data[size_bytes : size_bytes + parts.part_bytes]
        try:
            found = yield from PutPart(upload.id, upload.digest, whole_bytes, size_bytes, part, upload.signatures)
        except UnreachableError as exc:
            if exc.kind == "no_link" and size_bytes > first_bytes:
                raise UnreachableError(CAME_IN_PART, exc.message) from exc
            raise
        if found.sha is not None:
            return found.sha
        size_bytes = found.size_bytes
    raise UnreachableError("no_end", f"commit {upload.id} does not come to its end, part by part", 30.0)
