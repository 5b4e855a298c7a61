"""Peers of a relay, the two places between which it hands commits over: servers, or a folder in transit.

A relay is a client's program; `cairn serve --upstream` gives it the server's own map without a detour through HTTP.
`CommitList` is the list of a place's commits as JSON, without their bytes.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Protocol

from pydantic import BaseModel, ConfigDict, Field

from cairn_map.commits.attachment import Attachment
from cairn_map.commits.ids import Author, CommitId, author_from_text, commit_id_from_text
from cairn_map.commits.version_vector import AUTHORS_MAX, VersionVector, version_vector_from_json
from cairn_map.errors import CairnError
from cairn_map.wire.messages import WANTED_MAX, IdText, MapInfo, VectorJson

SumText = Annotated[str, Field(pattern=r"^[0-9a-f]{32}$")]

SUM_BYTES = 16
TOO_MANY_MAPS = "too_many_maps"
"""Kind of the error of a server that makes no more maps for its upstream."""


@dataclass(frozen=True, slots=True)
class SignedCommit:
    """A commit in transit: its bytes, and the signatures that prove its author."""

    id: CommitId
    data: bytes = field(repr=False)
    signatures: str | None = field(repr=False)
    """Text of the header `Cairn-Signature`; None: the commit is unsigned, and no relay may hand it over."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Held:
    """Commits that one place holds."""

    vector: VersionVector
    """Ids of all commits, folded or not."""
    wanted: tuple[CommitId, ...] = ()
    """Ids in `vector` whose bytes are wanted again."""
    sums: Mapping[Author, bytes] = field(default_factory=dict)
    """By author, if none of its commits waits to be folded: `sum_of_shas` of its commits."""


def sum_of_shas(before: bytes, shas: Iterable[bytes]) -> bytes:
    """(16 bytes) sum of `before` and of the first 16 bytes of each SHA-256; the order does not matter."""
    total = sum((int.from_bytes(sha[:SUM_BYTES]) for sha in shas), int.from_bytes(before))
    return (total % (1 << 8 * SUM_BYTES)).to_bytes(SUM_BYTES)


class MapEnd(Protocol):
    """One map in one place. Every method may be repeated."""

    def held(self) -> Held:
        """Commits that the place holds now.

        Raises:
            CairnError: the place cannot be reached.
        """
        ...

    def commit(self, commit: CommitId) -> SignedCommit:
        """The commit of an id.

        Raises:
            NotFoundError: kind `no_commit`.
            ConflictError: kind `evidence_gone`: its bytes are not kept any more.
        """
        ...

    def push(self, commit: SignedCommit) -> None:
        """Keep a commit; durable on return.

        Raises:
            CairnError: as a server's push.
        """
        ...


class AttachmentEnd(MapEnd, Protocol):
    """The same with the attachments of its marks."""

    def has_attachments(self) -> bool:
        """False if the place has none that it could give; True, too, where finding out would take a request."""
        ...

    def wanted_attachments(self) -> list[Attachment]:
        """Attachments that marks in this place name and whose bytes it lacks; the first ones of many.

        Raises:
            CairnError: the place cannot be reached, or it knows no attachments.
        """
        ...

    def attachment(self, attachment: Attachment) -> bytes | None:
        """Bytes of an attachment, compared with its SHA-256; None if they are not here.

        Raises:
            CairnError: the place cannot be reached.
        """
        ...

    def keep_attachment(self, attachment: Attachment, data: bytes) -> None:
        """Keep the bytes of an attachment that is wanted; durable on return.

        Raises:
            CairnError: the place refuses it, or cannot be reached.
        """
        ...


class OwnServer(Protocol):
    """The server that `cairn serve --upstream` connects to another one."""

    def map_names(self) -> list[str]:
        """Names of the server's maps."""
        ...

    def open(self, upstream: MapInfo) -> AttachmentEnd:
        """The server's map of the same name as the upstream's, created if there is none.

        Raises:
            ConflictError: kind `map_exists`: it has another grid or sensor model. Kind `too_many_maps`: it is not here,
                and no more maps are made for an upstream.
        """
        ...

    def clock_s(self) -> float:
        """Seconds by the server's own clock for ages, which never jumps."""
        ...

    def handed_over(self, map_name: str, begun_s: float) -> None:
        """Note that all signed commits of a map at a time (`clock_s`) were handed to the upstream."""
        ...

    def note_round(self, map_name: str | None, ill: CairnError | None) -> None:
        """Note how a round with a map, or (None) with the upstream server as a whole, went; `ill` is None if well."""
        ...


class CommitList(BaseModel):
    """Answer to `GET /maps/{map}/commits`."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    vector: VectorJson
    """All ids that are here, folded or not."""
    wanted: Annotated[list[IdText], Field(max_length=WANTED_MAX)] = []
    """Ids in `vector` whose bytes are wanted again."""
    sums: Annotated[dict[str, SumText], Field(max_length=AUTHORS_MAX)] = {}
    """By author of whom no commit waits to be folded: the sum of the first 16 bytes of their SHA-256, in hex."""


def commit_list(held: Held) -> CommitList:
    """Commits held, as a list in JSON; the mirror of `held_from_list`."""
    return CommitList(
        vector=held.vector.to_json(),
        wanted=[str(commit) for commit in held.wanted],
        sums={str(author): total.hex() for author, total in sorted(held.sums.items())},
    )


def held_from_list(message: CommitList) -> Held:
    """Commits held, of a list in JSON; the mirror of `commit_list`.

    Raises:
        BadInputError: an id or the vector is malformed.
    """
    return Held(
        vector=version_vector_from_json(message.vector),
        wanted=tuple(commit_id_from_text(text) for text in message.wanted),
        sums={author_from_text(text): bytes.fromhex(total) for text, total in message.sums.items()},
    )
