"""Relay to an upstream server: both servers then hold the same commits.

The relay is a robot's program, found through its entry point as `cairn` finds its commands; this server's own maps are
handed to it without a detour through HTTP (`cairn_map.wire.relay_peer`).
"""

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import entry_points
from typing import Protocol

from cairn_map.commits.attachment import Attachment
from cairn_map.commits.ids import CommitId, map_of_layer
from cairn_map.epochs.layer import LayerDefinition
from cairn_map.errors import BadInputError, CairnError, ConflictError, NotFoundError
from cairn_map.wire.mark_messages import PAGE_MAX
from cairn_map.wire.messages import CreateMap, MapInfo
from cairn_map.wire.relay_peer import TOO_MANY_MAPS, AttachmentEnd, Held, OwnServer, SignedCommit
from cairn_server.access.auth import UPSTREAM
from cairn_server.map_refusals import check_same_layer
from cairn_server.service import Service
from cairn_server.store.store_rows import MapRow
from cairn_server.sync.handing_over import found_commit

GROUP = "cairn.upstream"
PART_BYTES = 1 << 20
"""Bytes of an attachment that are kept in one transaction."""


class Relay(Protocol):
    """A running relay, as the entry point returns it."""

    def wake(self) -> None:
        """Note that this server has something new."""
        ...

    def use_token(self, token: str | None) -> None:
        """Show the upstream server this token from now on."""
        ...

    def stop(self) -> None:
        """End soon."""
        ...


@contextmanager
def joined(service: Service) -> Iterator[Relay | None]:
    """Hold the same commits as the upstream server, if one is set, for the length of a `with`; its relay.

    Raises:
        BadInputError: kind `bad_setting`: the relay is not installed; or `bad_url`.
    """
    settings = service.settings
    if settings.upstream is None:
        yield None
        return
    point = next(iter(entry_points(group=GROUP)), None)
    if point is None:
        raise BadInputError(
            "bad_setting", f"--upstream: no package offers a relay (entry points {GROUP}); install cairn again"
        )
    relay: Relay = point.load()(settings.upstream, settings.upstream_token, OwnMaps(service))
    service.sync.upstream.connect(relay.wake)
    try:
        yield relay
    finally:
        relay.stop()


class OwnEnd:
    """One map of this server, as a relay's `AttachmentEnd`."""

    def __init__(self, service: Service, row: MapRow) -> None:
        self._service = service
        self._row = row

    def held(self) -> Held:
        """Commits that this server has now."""
        return self._service.sync.held.of(self._row)

    def commit(self, commit: CommitId) -> SignedCommit:
        """A commit with its signatures."""
        found = found_commit(self._service.store, self._row, str(commit))
        return SignedCommit(commit, found.data, found.signatures)

    def push(self, commit: SignedCommit) -> None:
        """Keep a commit; durable on return."""
        pushes = self._service.sync.pushes
        try:
            pushes.keep(self._row, UPSTREAM, str(commit.id), commit.data, signatures=commit.signatures)
        except ConflictError as exc:
            pushes.note_conflict(self._row, UPSTREAM, exc)
            raise

    def has_attachments(self) -> bool:
        """True if any are whole here."""
        return bool(self._service.store.attachments.whole(self._row.number))

    def wanted_attachments(self) -> list[Attachment]:
        """Attachments that marks of the map name and that are not whole here."""
        return self._service.sync.attachments.wanted(self._row, robot=None, limit=PAGE_MAX).wanted

    def attachment(self, attachment: Attachment) -> bytes | None:
        """Bytes of an attachment; None if they are not here."""
        try:
            return self._service.sync.attachments.data(self._row, attachment.sha256)
        except NotFoundError:
            return None

    def keep_attachment(self, attachment: Attachment, data: bytes) -> None:
        """Keep an attachment, whole."""
        transfer, begin = self._service.sync.attachments, 0
        # What the upstream began to send before a kill goes on from there.
        for _ in range(2 * (len(data) // PART_BYTES + 2)):
            state = transfer.add(
                self._row,
                UPSTREAM,
                attachment.sha256,
                total_bytes=len(data),
                begin_bytes=begin,
                data=data[begin : begin + PART_BYTES],
            )
            if state.is_whole:
                return
            begin = state.held_bytes


class OwnMaps:
    """All maps of this server, as a relay's `OwnServer`."""

    def __init__(self, service: Service) -> None:
        self._service = service

    def map_names(self) -> list[str]:
        """Names of the maps."""
        return [row.name for row in self._service.store.maps()]

    def open(self, upstream: MapInfo) -> AttachmentEnd:
        """The map of the same name as one of the upstream, created if it is not there.

        Raises:
            ConflictError: kind `map_exists`; or `too_many_maps`: the upstream could name any number. Kind
                `other_layer`: a layer of that name is here with another definition.
            NotFoundError: kind `gone`: it was deleted here, and no other server's word brings it back. Kind `no_map`: a
                layer, and the commit that defines it has not come yet.
        """
        is_layer = map_of_layer(upstream.name) is not None
        try:
            row = self._service.store.map(upstream.name)
        except NotFoundError as exc:
            if exc.kind == "gone":
                raise
            if is_layer:
                raise NotFoundError(
                    "no_map", f"layer {upstream.name} is not here yet: it comes with a commit of its map"
                ) from exc
            self._check_place()
        else:
            if is_layer:
                _check_same(row, upstream)
                return OwnEnd(self._service, row)
        request = CreateMap(geometry=upstream.geometry, sensor_model=upstream.sensor_model, epoch_s=upstream.epoch_s)
        _, is_new = self._service.maps.create(upstream.name, request)
        if is_new:
            self._service.store.audit_log.add(UPSTREAM.name, "create_map", f"map {upstream.name}: created")
        return OwnEnd(self._service, self._service.store.map(upstream.name))

    def _check_place(self) -> None:
        """Raises: ConflictError: kind `too_many_maps`: no more maps are made for the upstream."""
        maps = [row for row in self._service.store.maps() if row.of_map is None]  # of layers a map has few
        count, most = len(maps), self._service.settings.upstream_maps_max
        if count >= most:
            raise ConflictError(
                TOO_MANY_MAPS,
                f"this server has {count} maps, and makes none for its upstream beyond {most}; if it should have this "
                "one, create it here (cairn map create), or raise upstream_maps_max and start again",
            )

    def clock_s(self) -> float:
        """Age of the store."""
        return self._service.store.age.now_s()

    def handed_over(self, map_name: str, begun_s: float) -> None:
        """Note that all of a map at this age of the store was given to the upstream, if it can travel."""
        self._service.sync.upstream.handed_over(map_name, begun_s)

    def note_round(self, map_name: str | None, ill: CairnError | None) -> None:
        """Note how a round with the upstream went."""
        self._service.sync.upstream.note_round(map_name, ill)


def _check_same(row: MapRow, upstream: MapInfo) -> None:
    """Raises: ConflictError: kind `other_layer`: the upstream's layer of this name is another one."""
    check_same_layer(
        row.name,
        row.layer,
        LayerDefinition(name=row.name.partition(".")[2], geometry=upstream.geometry, epoch_s=upstream.epoch_s),
    )


_IS_AN_OWN_SERVER: type[OwnServer] = OwnMaps
"""Check of the protocol by the type checker."""
