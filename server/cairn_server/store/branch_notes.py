"""What a store keeps of branches besides their rows: the last status of each; and what the log cost, for their lag."""

from typing import NamedTuple, Protocol

from cairn_map.commits.ids import Author
from cairn_server.store.store_rows import MapRow


class EntrySize(NamedTuple):
    """What one log entry weighs."""

    seq: int
    author: Author | None
    """Whose evidence came; None: some was taken out, which is news to its author, too."""
    size_bytes: int


class BranchNotes(Protocol):
    """Reached as `Store.notes`; every method may be called from any thread."""

    def put_status(self, row: MapRow, branch: str, status: str) -> None:
        """Keep the last status of a branch, as JSON, if there is such a branch; may be written later.

        It goes with the branch.
        """
        ...

    def statuses(self, row: MapRow) -> dict[str, str]:
        """The last status of each branch that ever told one."""
        ...

    def entry_sizes(self, row: MapRow, *, after_seq: int, limit: int) -> list[EntrySize]:
        """Log entries after one, oldest first, at most `limit`."""
        ...
