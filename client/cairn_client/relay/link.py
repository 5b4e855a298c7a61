"""Ends of a relay: over HTTP where an end is a server, by plain calls where it is not."""

from collections.abc import Mapping
from typing import Any, TypeVar

from cairn_client.http.answer_reading import sent_again
from cairn_client.http.api import MapApi
from cairn_client.http.attachment_copy import fetched_attachment, send_attachment
from cairn_client.http.http_link import Link
from cairn_client.relay.round import AskHeld, GiveCommit, RelaySide, TakeCommit
from cairn_client.sync.requests import Ask, Conversation, GetUpload, hold
from cairn_client.sync.uploads import PARTS as LARGER_PARTS
from cairn_client.sync.uploads import CommitUpload, push_rest
from cairn_map.commits.attachment import Attachment
from cairn_map.commits.ids import CommitId
from cairn_map.wire.messages import message_from_json
from cairn_map.wire.relay_peer import CommitList, Held, MapEnd, SignedCommit, held_from_list

T = TypeVar("T")
PARTS = LARGER_PARTS.after_a_cut()
"""Parts for links between servers: they break, or there would be one server."""


class RelayApi(MapApi):
    """One server's routes, those of relays included."""

    def held(self, name: str) -> Held:
        """Ids of the commits that a map has."""
        return held_from_list(message_from_json(CommitList, self._ask("GET", f"/maps/{name}/commits")))

    def signed_commit(self, name: str, commit: CommitId) -> SignedCommit:
        """A commit as it was pushed, with the signatures on it."""
        answer = self._send("GET", f"/maps/{name}/commits/{commit}")
        is_signed = "Cairn-Signature" in answer.headers
        return SignedCommit(commit, answer.body, sent_again(answer.headers, "Cairn-Signature") if is_signed else None)

    def hand_over(self, name: str, commit: SignedCommit) -> None:
        """Push a commit that its author signed; when this returns, the server has it for good."""
        headers = {"Cairn-Signature": commit.signatures} if commit.signatures else {}
        self._ask("PUT", f"/maps/{name}/commits/{commit.id}", content=commit.data, headers=headers)


class ServerEnd:
    """A map on a server, as one end of a relay (`relay_peer.MapEnd`)."""

    def __init__(self, api: RelayApi, map_name: str) -> None:
        self._api = api
        self._map_name = map_name

    def held(self) -> Held:
        """Ids of the commits that the map has now."""
        return self._api.held(self._map_name)

    def commit(self, commit: CommitId) -> SignedCommit:
        """A commit with its signatures."""
        return self._api.signed_commit(self._map_name, commit)

    def push(self, commit: SignedCommit) -> None:
        """Keep a commit; durable on return. A large one goes in parts, and continues where a cut left it."""
        if len(commit.data) > PARTS.above_bytes:
            upload = CommitUpload(commit.id, commit.data, commit.signatures)
            found = self._api.upload(self._map_name, GetUpload(commit.id, upload.digest))
            if found.sha is None:
                Link(self._api, self._map_name, branch="").hold(push_rest(upload, found.size_bytes, PARTS))
                return
        self._api.hand_over(self._map_name, commit)  # what is there already is compared

    def has_attachments(self) -> bool:
        """True: the other place says first what it wants."""
        return True

    def wanted_attachments(self) -> list[Attachment]:
        """Attachments that marks of the map name and the server lacks."""
        return self._api.wanted_attachments(self._map_name).wanted

    def attachment(self, attachment: Attachment) -> bytes | None:
        """Bytes of an attachment; None if the server does not have them."""
        return fetched_attachment(self._api, self._map_name, attachment.sha256)

    def keep_attachment(self, attachment: Attachment, data: bytes) -> None:
        """Send an attachment, in parts that go on where a cut left them."""
        send_attachment(self._api, self._map_name, attachment, data)


def hold_between(conversation: Conversation[T], here: MapEnd, there: MapEnd) -> T:
    """Result of a relay's conversation with two places.

    Raises:
        CairnError: an error of a place that the conversation does not deal with itself.
    """
    ends = {RelaySide.HERE: here, RelaySide.THERE: there}
    return hold(conversation, lambda ask: answer_of(ends, ask))


def answer_of(ends: Mapping[RelaySide, MapEnd], ask: Ask[Any]) -> Any:
    """Answer of an end to a relay's ask."""
    match ask:
        case AskHeld(side):
            return ends[side].held()
        case TakeCommit(side, commit):
            return ends[side].commit(commit)
        case GiveCommit(side, commit):
            return ends[side].push(commit)
    raise TypeError(f"no way to ask {ask!r}")
