"""Servers joined to others, each reached through its socket, as `cairn serve --upstream` joins them."""

from pathlib import Path
from types import TracebackType
from typing import Any, Self

from tests.cairn_client.made import GEOMETRY, MAP, random_diff
from tests.cairn_server.live.hub import Live, until

from cairn_client.http.api import MapApi
from cairn_client.relay.upstream import Upstream
from cairn_client.robot.robot import Robot
from cairn_map.commits.ids import CommitId
from cairn_map.wire.access_messages import CreateToken
from cairn_map.wire.messages import CreateMap, Retract
from cairn_server.access.auth import ADMIN_FILE
from cairn_server.access.tokens import create_token
from cairn_server.operations.local_peer import OwnMaps
from cairn_server.store.store_rows import MapRow
from cairn_server.sync.handing_over import server_key

ADMIN = "a" * 20
EVERY_S = 0.02


class Server(Live):
    """A server that wants tokens, and may be joined to others."""

    def __init__(self, folder: Path, **settings: Any) -> None:
        super().__init__(folder, admin_token=ADMIN, **settings)
        self.relays: list[Upstream] = []

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    @property
    def row(self) -> MapRow:
        """The one map."""
        return self.service.store.map(MAP)

    @property
    def key(self) -> str:
        """By which it signs its operators' retracts."""
        return server_key(self.row).public_key.hex()

    def create_map(self) -> None:
        self.service.create_map(MAP, CreateMap(geometry=GEOMETRY))

    def token(self, name: str, **fields: Any) -> str:
        """A new token."""
        return create_token(self.service.store, name, CreateToken(**fields), by=ADMIN_FILE).token

    def api(self) -> MapApi:
        return MapApi(self.url, token=ADMIN)

    def join(self, base: "Server") -> Upstream:
        """As `--upstream` does."""
        token = base.token(f"field{len(base.service.store.tokens.all())}", role="relay")
        relay = Upstream(base.url, token, OwnMaps(self.service), every_s=EVERY_S)
        self.service.joining.wake = relay.wake
        self.relays.append(relay)
        return relay

    def leave(self) -> None:
        """The link to all upstreams is cut for good."""
        for relay in self.relays:
            relay.stop()
        self.relays.clear()

    def retract(self, *commits: CommitId) -> None:  # type: ignore[override]
        """By an operator of this server."""
        self.service.retract(self.row, Retract(commits=[str(commit) for commit in commits]), by=ADMIN_FILE)

    def vias(self) -> dict[str, str | None]:
        """How each author's commits came here."""
        with self.api() as api:
            return {entry.id.split(".")[0]: entry.via for entry in api.log(MAP)}

    def ids(self) -> set[CommitId]:
        """All that is folded here."""
        with self.service.store.snapshot(self.row) as snapshot:
            return set(snapshot.head.vector)

    def digests(self) -> dict[int, bytes]:
        """What two equal maps have in common."""
        self.folded(self.row)
        with self.service.store.snapshot(self.row) as snapshot:
            return {cell.key: cell.digest for cell in snapshot.cells() if cell.voxels}

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.leave()
        super().__exit__(kind, error, trace)

    def __enter__(self) -> Self:
        return self


def settled(*servers: Server) -> None:
    """Return when all have the same commits, folded."""

    def is_level() -> bool:
        return len({frozenset(server.ids()) for server in servers}) == 1

    for _ in range(2):
        until(is_level, "all servers have the same commits")
        for server in servers:
            server.folded(server.row)
    assert len({frozenset(server.digests().items()) for server in servers}) == 1


def opened(server: Server, folder: Path, name: str) -> Robot:
    """A robot of a server, with a token of its own."""
    token = server.token(name, role="robot", map=MAP, robot=name)
    return Robot(None, f"{server.url}/maps/{MAP}", directory=folder, name=name, token=token, geometry=GEOMETRY)


def mapped(server: Server, folder: Path, name: str, *seeds: int) -> Robot:
    """A robot that maps something at a server and goes away."""
    with opened(server, folder, name) as robot:
        for seed in seeds:
            robot.replica.commit(random_diff(seed))
        robot.sync()
    return robot
