"""Conversations of `sync.requests` held over HTTP: each request is sent, and its answer handed back."""

from collections.abc import Callable, Generator
from typing import Any, TypeVar

from cairn_client.http.api import MapApi
from cairn_client.sync.indexed_cells import MapIndex
from cairn_client.sync.requests import (
    Ask,
    Conversation,
    GetCell,
    GetCommit,
    GetIndex,
    GetMissing,
    GetUpload,
    GetView,
    NextFrame,
    Push,
    PutCell,
    PutPart,
    hold,
    whole_index,
)
from cairn_map.codec.cell_reading import EVIDENCE_BYTES_MAX
from cairn_map.codec.history_code import DecodedHistory
from cairn_map.codec.layer_code import decode_layer_cell
from cairn_map.epochs.cell_history import history_fingerprint
from cairn_map.epochs.layer import MapLayer
from cairn_map.errors import DamagedDataError
from cairn_map.evidence.grid import CellKey, cell_of_key
from cairn_map.wire.frames import Frame
from cairn_map.wire.resumed_replies import Replies

T = TypeVar("T")


class Link:
    """HTTP link of one robot to one map: it holds conversations."""

    def __init__(
        self, api: MapApi, map_name: str, *, branch: str, has_epochs: Callable[[], bool] = lambda: True
    ) -> None:
        self._api = api
        self._has_epochs = has_epochs
        self._map_name = map_name
        self._branch = branch
        self._frames: Generator[Frame, None, None] | None = None
        self._replies = Replies()

    def hold(self, conversation: Conversation[T]) -> T:
        """Result of a conversation with the server.

        Raises:
            CairnError: an error of the server or the link that the conversation does not deal with itself.
        """
        try:
            return hold(conversation, self._answer)
        finally:
            self._stop_reading()

    def _answer(self, ask: Ask[Any]) -> Any:
        api, name = self._api, self._map_name
        match ask:
            case Push(commit, seal, signatures):
                api.push(name, commit, seal=seal, signatures=signatures)
                return None
            case GetUpload() | PutPart():
                return api.upload(name, ask)
            case GetCommit(commit_id):
                return api.commit(name, commit_id)
            case GetMissing(request):
                self._stop_reading()
                self._frames = api.missing(
                    name, self._branch, request, replies=self._replies, has_epochs=self._has_epochs()
                )
                return next(self._frames, None)
            case NextFrame():
                return next(self._frames, None) if self._frames else None
            case GetIndex(author, box, after, held):
                return api.cell_index(name, author, box=box, after=after, held=held)
            case GetView(cell):
                return api.cell_view(name, cell)
            case GetCell(cell, etag):
                return api.cell(name, cell, etag=etag)
            case PutCell(cell, body):
                api.put_cell(name, cell, body)
                return None
        raise TypeError(f"no way to ask {ask!r}")

    def _stop_reading(self) -> None:
        """Close a reply that was not read to its end."""
        if self._frames is not None:
            self._frames.close()
            self._frames = None


def index_of(api: MapApi, map_name: str) -> MapIndex:
    """Index of all cells of a map, without their bytes, for programs that are no robots."""
    return Link(api, map_name, branch="").hold(whole_index())


def cells_with_evidence(api: MapApi, map_name: str) -> list[CellKey]:
    """Numbers of a map's cells that hold evidence, in order."""
    return index_of(api, map_name).cells.keys_with_evidence


def download_cell(
    api: MapApi, map_name: str, key: CellKey, layer: MapLayer, *, evidence_bytes_max: int = EVIDENCE_BYTES_MAX
) -> tuple[bytes, DecodedHistory]:
    """Bytes of one cell of a map of this layer, and the evidence that they decode to.

    Raises:
        BadInputError: kind `too_large`: the evidence would take more bytes than allowed.
        DamagedDataError: kind `fingerprint_mismatch`: it is not the cell that the server says it is.
    """
    cell = cell_of_key(key)
    fetched = api.cell(map_name, cell)
    body = fetched.body or b""
    decoded = decode_layer_cell(body, key, layer, evidence_bytes_max=evidence_bytes_max)
    if history_fingerprint(decoded.history, key, layer_word=layer.word) != fetched.fingerprint:
        raise DamagedDataError("fingerprint_mismatch", f"cell {cell} is not what the server says it is")
    return body, decoded
