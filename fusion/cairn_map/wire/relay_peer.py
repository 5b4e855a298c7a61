"""What a relay needs of each of the two places between which it hands commits over: servers, or a folder on its way.

A relay is a client's program; `cairn serve --upstream` gives it the server's own map without a detour through HTTP.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Protocol

from pydantic import BaseModel, ConfigDict, Field

from cairn_map.commits.ids import Author, CommitId, author_from_text, commit_id_from_text
from cairn_map.commits.version_vector import AUTHORS_MAX, VersionVector, version_vector_from_json
from cairn_map.wire.messages import WANTED_MAX, IdText, MapInfo, VectorJson

SumText = Annotated[str, Field(pattern=r"^[0-9a-f]{32}$")]

SUM_BYTES = 16


@dataclass(frozen=True, slots=True)
class SignedCommit:
    """A commit on its way: its bytes, and what proves whose it is."""

    id: CommitId
    data: bytes = field(repr=False)
    signatures: str | None = field(repr=False)
    """As in `Cairn-Signature`; None: nobody signed it, and no relay may hand it over."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Held:
    """Which commits there are in one place."""

    vector: VersionVector
    """All of them, folded or not."""
    wanted: tuple[CommitId, ...] = ()
    """Of those, the ones whose bytes are wanted again."""
    sums: Mapping[Author, bytes] = field(default_factory=dict)
    """Of authors of which no commit waits to be folded: the sum of their SHA-256, as `sum_of_shas`."""


def sum_of_shas(before: bytes, shas: Iterable[bytes]) -> bytes:
    """(16 bytes) the sum of the first 16 bytes of each of them, and of the one before: of whatever order."""
    total = sum((int.from_bytes(sha[:SUM_BYTES]) for sha in shas), int.from_bytes(before))
    return (total % (1 << 8 * SUM_BYTES)).to_bytes(SUM_BYTES)


class MapEnd(Protocol):
    """One map in one place. Every method may be repeated."""

    def held(self) -> Held:
        """What is here now.

        Raises:
            CairnError: it cannot be asked.
        """
        ...

    def commit(self, commit: CommitId) -> SignedCommit:
        """A commit.

        Raises:
            NotFoundError: kind `no_commit`.
            ConflictError: kind `evidence_gone`: its bytes are not kept here any more.
        """
        ...

    def push(self, commit: SignedCommit) -> None:
        """Keep a commit; durable on return.

        Raises:
            CairnError: as a server's push.
        """
        ...


class OwnServer(Protocol):
    """The server that `cairn serve --upstream` joins to another one."""

    def map_names(self) -> list[str]:
        """Its maps."""
        ...

    def open(self, upstream: MapInfo) -> MapEnd:
        """Its map of the same name, made if it is not there.

        Raises:
            ConflictError: kind `map_exists`: it has another grid or sensor model.
        """
        ...

    def handed_over(self, map_name: str, begun_s: float) -> None:
        """All that was in its map at this time (UTC seconds since 1970) was given to the upstream, if it can travel."""
        ...


class CommitList(BaseModel):
    """Answer to `GET /maps/{map}/commits`."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    vector: VectorJson
    """All ids that are here, folded or not."""
    wanted: Annotated[list[IdText], Field(max_length=WANTED_MAX)] = []
    """Of those, the ones whose bytes are wanted again."""
    sums: Annotated[dict[str, SumText], Field(max_length=AUTHORS_MAX)] = {}
    """By author of whom no commit waits to be folded: the sum of the first 16 bytes of their SHA-256, in hex."""


def commit_list(held: Held) -> CommitList:
    """As JSON has it; the mirror of `held_from_list`."""
    return CommitList(
        vector=held.vector.to_json(),
        wanted=[str(commit) for commit in held.wanted],
        sums={str(author): total.hex() for author, total in sorted(held.sums.items())},
    )


def held_from_list(message: CommitList) -> Held:
    """What is held.

    Raises:
        BadInputError: an id or the vector is malformed.
    """
    return Held(
        vector=version_vector_from_json(message.vector),
        wanted=tuple(commit_id_from_text(text) for text in message.wanted),
        sums={author_from_text(text): bytes.fromhex(total) for text, total in message.sums.items()},
    )
