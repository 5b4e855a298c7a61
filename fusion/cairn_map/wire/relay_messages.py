"""What a relay asks of a server, as JSON: which commits there are, without anything of their bytes."""

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from cairn_map.commits.ids import author_from_text, commit_id_from_text
from cairn_map.commits.version_vector import AUTHORS_MAX, version_vector_from_json
from cairn_map.wire.messages import WANTED_MAX, IdText, VectorJson
from cairn_map.wire.relay_peer import Held

SumText = Annotated[str, Field(pattern=r"^[0-9a-f]{32}$")]


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
