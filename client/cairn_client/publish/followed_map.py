"""A server's map in memory, followed by its live events: only cells that changed are downloaded again."""

from collections.abc import Collection

from cairn_client.folders.map_folder import download_into
from cairn_client.http.api import MapApi
from cairn_client.http.http_link import index_of
from cairn_map.codec.cell_code import coding_of
from cairn_map.epochs.history_map import HistoryMap
from cairn_map.evidence.grid import CellKey, cell_key
from cairn_map.machine_memory import standard_limit_bytes
from cairn_map.queries.map_snapshot import MapSnapshot, snapshot_of
from cairn_map.wire.live_events import CellsEvent


class FollowedMap:
    """Copy of a map, of the state that was last fetched; not thread-safe.

    Raises:
        BadInputError: kind `too_large`: the map takes more than a quarter of the machine's memory.
        CairnError: the server refuses, or does not answer.
    """

    def __init__(self, api: MapApi, name: str) -> None:
        self._api = api
        self.info = api.map_info(name)
        self._whole = HistoryMap(self.info.layer, coding=coding_of(self.info.geometry))
        self._digests: dict[CellKey, str] = {}
        """Digests of the cells that are as the index had them; a cell that changed since then has none."""
        self._waiting: set[CellKey] = set()
        """Cells of which a change was heard."""
        self._fetched: set[CellKey] = set()
        """Cells that came, and that no `fetch` has returned yet: the link broke before it ended."""
        self._is_any = True
        """True if any cell may have changed."""
        self.snapshot: MapSnapshot = snapshot_of(self._whole, self.info.sensor_model)

    def note(self, event: CellsEvent) -> None:
        """Note cells that changed, to be fetched."""
        if event.cells == "many":
            self._is_any = True
        else:
            heard = {cell_key((i, j, k)) for i, j, k, _ in event.cells}
            self._waiting |= heard
            # Else evidence that is taken out while the link is broken would stay: the index has the old digest again.
            for key in heard:
                self._digests.pop(key, None)

    def note_any(self) -> None:
        """Note that any cell may have changed: the listener missed something."""
        self._is_any = True

    @property
    def has_news(self) -> bool:
        """True if there may be cells to fetch."""
        return self._is_any or bool(self._waiting)

    def fetch(self) -> Collection[CellKey]:
        """Fetch the cells that changed; their numbers, in order, with those that came before a link broke."""
        if self._is_any:
            entries = {cell_key(entry.cell): entry for entry in index_of(self._api, self.info.name).cells}
            # A cell without voxels that is not held is no news.
            self._waiting |= {
                key
                for key, entry in entries.items()
                if self._digests.get(key) != entry.digest and (entry.voxels or key in self._whole)
            }
            self._digests |= {key: entries[key].digest for key in self._waiting & entries.keys()}
            self._is_any = False
        for key in sorted(self._waiting):
            download_into(self._whole, self._api, self.info, key, memory_bytes_max=standard_limit_bytes())
            self._waiting.discard(key)
            self._fetched.add(key)
        self.snapshot = self.snapshot.refreshed(self._whole)
        changed = sorted(self._fetched)
        self._fetched.clear()
        return changed
