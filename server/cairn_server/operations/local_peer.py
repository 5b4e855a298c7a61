"""The server itself as a relay's place, without a detour through HTTP (`cairn_map.wire.relay_peer`)."""

from cairn_map.commits.ids import CommitId
from cairn_map.errors import ConflictError
from cairn_map.wire.messages import CreateMap, MapInfo
from cairn_map.wire.relay_peer import Held, MapEnd, OwnServer, SignedCommit
from cairn_server.access.auth import UPSTREAM
from cairn_server.service import Service
from cairn_server.store.store_rows import MapRow
from cairn_server.sync.handing_over import found_commit


class OwnEnd:
    """`MapEnd` of one map."""

    def __init__(self, service: Service, row: MapRow) -> None:
        self._service = service
        self._row = row

    def held(self) -> Held:
        """What is here now."""
        return self._service.held.of(self._row)

    def commit(self, commit: CommitId) -> SignedCommit:
        """A commit."""
        found = found_commit(self._service.store, self._row, str(commit))
        return SignedCommit(commit, found.data, found.signatures)

    def push(self, commit: SignedCommit) -> None:
        """Keep a commit; durable on return."""
        try:
            self._service.push(self._row, UPSTREAM, str(commit.id), commit.data, signatures=commit.signatures)
        except ConflictError as exc:
            self._service.pushes.note_conflict(self._row, UPSTREAM, exc)
            raise


class OwnMaps:
    """`OwnServer`: all maps of a service."""

    def __init__(self, service: Service) -> None:
        self._service = service

    def map_names(self) -> list[str]:
        """Its maps."""
        return [row.name for row in self._service.store.maps()]

    def open(self, upstream: MapInfo) -> MapEnd:
        """Its map of the same name, made if it is not there."""
        request = CreateMap(geometry=upstream.geometry, sensor_model=upstream.sensor_model)
        _, is_new = self._service.create_map(upstream.name, request)
        if is_new:
            self._service.store.audit_log.add(UPSTREAM.name, "create_map", upstream.name)
        return OwnEnd(self._service, self._service.store.map(upstream.name))

    def handed_over(self, map_name: str, begun_s: float) -> None:
        """All that was in its map at this time was given to the upstream, if it can travel."""
        self._service.joining.handed_over(map_name, begun_s)


_IS_AN_OWN_SERVER: type[OwnServer] = OwnMaps
"""Refused by the type checker if it is none."""
