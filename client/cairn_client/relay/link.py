"""The rounds of a relay, held: over HTTP where an end is a server, and by plain calls where it is not."""

from collections.abc import Mapping
from typing import Any, TypeVar

from cairn_client.http.api import MapApi
from cairn_client.http.http_link import Link
from cairn_client.relay.round import AskHeld, GiveCommit, Side, TakeCommit
from cairn_client.sync.requests import Ask, Conversation, GetUpload
from cairn_client.sync.uploads import PARTS as LARGER_PARTS
from cairn_client.sync.uploads import Body, push_rest
from cairn_map.commits.ids import CommitId
from cairn_map.errors import CairnError
from cairn_map.wire.messages import message_from_json
from cairn_map.wire.relay_peer import CommitList, Held, MapEnd, SignedCommit, held_from_list

T = TypeVar("T")
PARTS = LARGER_PARTS.after_a_cut()
"""Links between servers are those that break, or there would be one server."""


class RelayApi(MapApi):
    """One server's routes, those of relays included."""

    def held(self, name: str) -> Held:
        """Which commits a map has."""
        return held_from_list(message_from_json(CommitList, self._ask("GET", f"/maps/{name}/commits")))

    def signed_commit(self, name: str, commit: CommitId) -> SignedCommit:
        """A commit as it was pushed, with the signatures on it."""
        answer = self._send("GET", f"/maps/{name}/commits/{commit}")
        return SignedCommit(commit, answer.body, answer.headers.get("Cairn-Signature"))

    def hand_over(self, name: str, commit: SignedCommit) -> None:
        """Push what somebody else signed; when this returns, the server has it for good."""
        headers = {"Cairn-Signature": commit.signatures} if commit.signatures else {}
        self._ask("PUT", f"/maps/{name}/commits/{commit.id}", content=commit.data, headers=headers)


class ServerEnd:
    """`MapEnd` of a map on a server."""

    def __init__(self, api: RelayApi, map_name: str) -> None:
        self._api = api
        self._map_name = map_name

    def held(self) -> Held:
        """What is there now."""
        return self._api.held(self._map_name)

    def commit(self, commit: CommitId) -> SignedCommit:
        """A commit."""
        return self._api.signed_commit(self._map_name, commit)

    def push(self, commit: SignedCommit) -> None:
        """Keep a commit; durable on return. A large one goes in parts, and on from what came before a cut."""
        if len(commit.data) > PARTS.above_bytes:
            body = Body(commit.id, commit.data, commit.signatures)
            found = self._api.upload(self._map_name, GetUpload(commit.id, body.digest))
            if found.sha is None:
                Link(self._api, self._map_name, branch="").hold(push_rest(body, found.size_bytes, PARTS))
                return
        self._api.hand_over(self._map_name, commit)  # what is there already is compared


def hold_between(conversation: Conversation[T], here: MapEnd, there: MapEnd) -> T:
    """The result of a relay's conversation with two places.

    Raises:
        CairnError: what the conversation does not deal with itself.
    """
    ends = {Side.HERE: here, Side.THERE: there}
    try:
        ask = next(conversation)
        while True:
            try:
                answer = answer_of(ends, ask)
            except CairnError as exc:
                ask = conversation.throw(exc)
            else:
                ask = conversation.send(answer)
    except StopIteration as end:
        result: T = end.value
        return result


def answer_of(ends: Mapping[Side, MapEnd], ask: Ask[Any]) -> Any:
    """What an end says to a relay."""
    match ask:
        case AskHeld(side):
            return ends[side].held()
        case TakeCommit(side, commit):
            return ends[side].commit(commit)
        case GiveCommit(side, commit):
            return ends[side].push(commit)
    raise TypeError(f"no way to ask {ask!r}")
