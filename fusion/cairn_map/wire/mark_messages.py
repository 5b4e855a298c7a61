"""JSON messages about marks: pages of them, and what an operator asks for."""

from collections import defaultdict
from collections.abc import Iterable
from typing import Annotated, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, FailFast, Field, model_validator

from cairn_map.commits.attachment import ATTACHMENT_BYTES_MAX, Attachment
from cairn_map.commits.ids import CommitId, commit_id_from_text
from cairn_map.commits.mark import Mark, MarkKey, mark_key_from_text
from cairn_map.errors import BadInputError
from cairn_map.wire.messages import CursorText, IdText

PAGE_MAX = 1000
"""Marks asked for at a time; a page ends with a whole commit, and may be longer by one."""
KeyText = Annotated[str, Field(max_length=104)]
"""`robot.incarnation.n:number`."""
Metres = Annotated[float, Field(allow_inf_nan=False)]


def _check_key(text: str) -> str:
    try:
        return str(mark_key_from_text(text))
    except BadInputError as exc:
        raise ValueError(exc.message) from exc


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class MarkEntry(_Model):
    """One mark of a map."""

    key: Annotated[KeyText, AfterValidator(_check_key)]
    mark: Mark
    amends: Annotated[tuple[IdText, ...], FailFast()] = ()
    """Commits whose marks this one's commit took the place of."""

    @property
    def mark_key(self) -> MarkKey:
        """The key, parsed."""
        return mark_key_from_text(self.key)

    @property
    def author(self) -> str:
        """Robot or person that speaks."""
        return self.mark.by or self.mark_key.commit.author.robot


def edited_twice(entries: Iterable[MarkEntry]) -> frozenset[str]:
    """Keys of those marks that several commits put in the place of the same one; nothing says which is right."""
    found = list(entries)
    edits: defaultdict[str, set[CommitId]] = defaultdict(set)
    for entry in found:
        for commit in entry.amends:
            edits[commit].add(entry.mark_key.commit)
    return frozenset(entry.key for entry in found if any(len(edits[commit]) > 1 for commit in entry.amends))


class MarkPage(_Model):
    """Answer to `GET /maps/{map}/main/marks`."""

    cursor: CursorText
    """State up to which this page goes: `after` of the next question."""
    from_start: bool
    """True if `after` was not stated, or is not of this log: marks that are not in the pages from here on are gone."""
    more: bool
    """True if there may be more up to the map's present state."""
    marks: Annotated[list[MarkEntry], FailFast()]
    """Marks that came after `after`, oldest first."""
    removed: Annotated[list[IdText], FailFast()] = []
    """Commits whose marks were taken out after `after`."""

    @property
    def removed_ids(self) -> tuple[CommitId, ...]:
        """The ids, parsed."""
        return tuple(commit_id_from_text(text) for text in self.removed)


class MarkText(_Model):
    """Mark as a person states it: in metres; the server adds who and when."""

    kind: str
    name: str
    place_m: tuple[Metres, Metres, Metres]
    extent_m: tuple[Metres, Metres, Metres] = (0.0, 0.0, 0.0)
    note: str = ""
    attachment: Attachment | None = None
    """Bytes that belong to it, which are sent on their own once the mark is there."""


class MarkRequest(_Model):
    """Body of `POST /maps/{map}/main/marks`: a new mark, another text for one, or (without `mark`) its removal."""

    mark: MarkText | None = None
    of: KeyText | None = None
    """Mark that is changed or removed; None: this one is new."""

    @model_validator(mode="after")
    def _says_something(self) -> Self:
        if self.mark is None and self.of is None:
            raise ValueError("this takes a mark to add, a key `of` one to remove, or both to change it")
        return self


class MarkReceipt(_Model):
    """Answer to it."""

    commit: IdText
    """Commit that says it."""
    key: KeyText | None
    """The mark from here on; None: it was removed."""


class WantedAttachments(_Model):
    """Answer to `GET /maps/{map}/main/attachments`."""

    wanted: Annotated[list[Attachment], FailFast()]
    """Attachments that marks of the map name and that the server does not have whole, the oldest first."""
    more: bool
    """True if there may be more of them."""


class AttachmentState(_Model):
    """Answer to `PATCH /maps/{map}/main/attachments/{sha}`."""

    held_bytes: Annotated[int, Field(ge=0, le=ATTACHMENT_BYTES_MAX)]
    """Bytes that are there from this sender, from the first one on: the next part begins here."""
    is_whole: bool
    """True once all bytes are there and have the SHA-256."""
