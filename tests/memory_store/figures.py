"""What a store in memory tells of itself: its health, what robots' commits took, what is kept of branches."""

from collections import Counter, defaultdict
from collections.abc import Mapping
from contextlib import suppress

from tests.memory_store.map import MemoryMap
from tests.memory_store.maps import MemoryMaps

from cairn_map.commits.cursor import ENTRY_FOLD
from cairn_map.errors import NotFoundError, UnreachableError
from cairn_server.map_refusals import check_assignment_count
from cairn_server.store.shares import full_authors
from cairn_server.store.store_age import StoreAge
from cairn_server.store.store_rows import (
    Backlog,
    CellRow,
    ClosedRobot,
    EntrySize,
    HeardRobot,
    MapRow,
    Robot,
    RobotShares,
    StoreFigures,
    Use,
    UsedPart,
    relay_of,
)


class MemoryHealth:
    """`store.StoreHealth` without a disk: nothing waits to be written, and nothing runs full but the process."""

    def __init__(self, maps: MemoryMaps, age: StoreAge) -> None:
        self._maps = maps
        self._age = age

    def backlogs(self) -> list[Backlog]:
        """What is not folded yet, of the maps that have any."""
        with self._maps.locked() as maps:
            found = [(state.row.name, list(state.due())) for state in maps.values()]
        now_s = self._age.now_s()
        return [Backlog(name, len(due), now_s - due[0].received_age_s) for name, due in found if due]

    def figures(self) -> StoreFigures:
        """Sizes and counts."""
        with self._maps.locked() as maps:
            size_bytes = sum(_size_bytes(state) for state in maps.values())
            cells = [cell for state in maps.values() for cell in state.cells.values() if cell.voxels]
            return StoreFigures(
                size_bytes=size_bytes,
                ahead_bytes=0,
                free_bytes=0,
                queued=0,
                written=self._maps.written,
                emptied=0,
                failures={},
                cells_bytes=sum(cell.size_bytes for cell in cells),
                history_bytes=sum(cell.history_bytes for cell in cells),
                evidence_bytes=sum(state.evidence_bytes() for state in maps.values()),
                log_entries=sum(state.head.seq for state in maps.values()),
                unused_bytes=0,
            )

    def check_space(self, free_bytes_min: int) -> None:
        """Refuse nothing: there is no disk."""

    def shrink(self) -> bool:
        """Nothing: there is no file."""
        return False

    def heal(self, row: MapRow, cell: CellRow) -> bool:
        """Put sound bytes in the place of a damaged cell; False if it changed meanwhile."""
        with self._maps.changing(row) as changed:
            return changed.heal(cell)

    def probe(self) -> None:
        """Raise if the store is closed."""
        with self._maps.locked():
            pass


class MemoryUses:
    """`store.Uses`."""

    def __init__(self, maps: MemoryMaps) -> None:
        self._maps = maps

    def since(self, time_s: float) -> Mapping[Robot, Use]:
        """What each robot's commits took that came after a time, and what each relay handed over."""
        found: defaultdict[Robot, Use] = defaultdict(Use)
        with self._maps.locked() as maps:
            for state in maps.values():
                for commit, kept in state.commits.items():
                    if kept.received_s >= time_s:
                        who = relay_of(kept.new.via) if kept.new.via else commit.author.robot
                        found[state.row.number, who] += Use(kept.new.size_bytes, kept.cells)
        return found


class MemoryShares:
    """`store.Shares`, added up from the commits whenever it is asked."""

    def __init__(self, maps: MemoryMaps) -> None:
        self._maps = maps

    def of(self, row: MapRow) -> list[RobotShares]:
        """Use of its shares by every robot, and of the reserve, by name."""
        with self._maps.reading(row) as state:
            return state.shares()

    def full_sums(self) -> list[UsedPart]:
        """Shares of the sums of which more than half is used, of all maps."""
        with self._maps.locked() as maps:
            return [
                UsedPart(name, share.robot, "sums", share.sums)
                for name, state in maps.items()
                for share in state.shares()
                if share.sums is not None
            ]

    def full_authors(self) -> list[UsedPart]:
        """The same of incarnations, intervals and robots."""
        with self._maps.locked() as maps:
            shares = [(name, share) for name, state in maps.items() for share in state.shares()]
        robots = Counter(name for name, share in shares if share.robot)
        return full_authors(
            [(name, share.robot, share.incarnations, share.intervals) for name, share in shares], robots.items()
        )

    def regions(self, row: MapRow, robot: str) -> list[int]:
        """Regions in which a robot has evidence, pending or in the map, rising."""
        with self._maps.reading(row) as state:
            return sorted(state.held(robot))

    def close(self, row: MapRow, robot: str) -> ClosedRobot:
        """Close all authors of a robot."""
        with self._maps.changing(row) as changed:
            return changed.close(robot)


class MemoryNotes:
    """`branch_signs.BranchNotes`."""

    def __init__(self, maps: MemoryMaps) -> None:
        self._maps = maps

    def put_status(self, row: MapRow, branch: str, status: str) -> None:
        """Keep the last status of a branch, as JSON, if there is such a branch."""
        with suppress(UnreachableError, NotFoundError), self._maps.changing(row) as changed:  # the next one comes soon
            if branch in changed.branches:
                changed.statuses[branch] = status

    def statuses(self, row: MapRow) -> dict[str, str]:
        """The last status of each branch that ever told one."""
        with self._maps.reading(row) as state:
            return dict(state.statuses)

    def heard(self, *, limit: int) -> list[HeardRobot]:
        """Robots of all maps by their last signs, the newest first."""
        with self._maps.locked() as maps:
            found = [
                HeardRobot(name, branch.name, branch.last_seen_s)
                for name, state in maps.items()
                for branch in state.branches.values()
            ]
        return sorted(found, key=lambda each: (-each.heard_s, each.map, each.robot))[:limit]

    def entry_sizes(self, row: MapRow, *, after_seq: int, limit: int) -> list[EntrySize]:
        """Log entries after one, oldest first, at most `limit`."""
        found: list[EntrySize] = []
        with self._maps.reading(row) as state:
            for seq, entry in enumerate(state.entries[after_seq : after_seq + limit], start=after_seq + 1):
                commit = state.commits[state.ids[entry.commit]].new
                author = commit.id.author if entry.kind == ENTRY_FOLD else None
                found.append(EntrySize(seq, author, commit.size_bytes))
        return found

    def assign(self, row: MapRow, robot: str, assignment: str | None) -> None:
        """Keep which layers of a map a robot takes part in, or (None) no more."""
        with self._maps.changing(row) as changed:
            changed.assignments.pop(robot, None)
            if assignment is not None:
                check_assignment_count(row.name, len(changed.assignments))
                changed.assignments[robot] = assignment

    def assignments(self, row: MapRow, robot: str | None = None) -> dict[str, str]:
        """Assignments of a map by robot: of all, or (one at most) of a robot."""
        with self._maps.reading(row) as state:
            return {name: text for name, text in sorted(state.assignments.items()) if robot in (None, name)}


def _size_bytes(state: MemoryMap) -> int:
    commits = sum(kept.new.size_bytes for kept in state.commits.values() if not kept.is_gone)
    return commits + sum(cell.size_bytes for cell in state.cells.values())
