"""Carried commits: others' commits in a folder of a robot, with a file for each, on their way to the next server.

    mole.1f2e3d4c5b6a7988.7      the signatures, a line feed, the commit's bytes; empty once there was no room for it
    attachments/                 what their marks name (`attachment_folder`)

The folder is one end of a relay, like a server. Its commits are on some server, too, so when it is full the oldest are
emptied; their names stay, so that they are not fetched again.
"""

import os
from collections.abc import Iterator
from pathlib import Path

from cairn_client.relay.carried_attachments import hand_over_attachments
from cairn_client.relay.link import RelayApi, ServerEnd, hold_between
from cairn_client.relay.round import RelayReport, Undelivered, log_report, relay_round
from cairn_client.replica.attachment_folder import ATTACHMENTS, AttachmentFolder
from cairn_client.replica.durable_file import write_durable_file
from cairn_map.commits.attachment import Attachment
from cairn_map.commits.commit import CommitMeta
from cairn_map.commits.commit_reading import validated_commit
from cairn_map.commits.ids import INITIAL, OPERATOR, CommitId, commit_id_from_text
from cairn_map.commits.signature import TEXT_MAX, check_signatures, signatures_from_text, speaks_for
from cairn_map.commits.version_vector import EMPTY
from cairn_map.errors import BadInputError, ConflictError, DamagedDataError, NotFoundError, UnreachableError
from cairn_map.wire.relay_peer import Held, SignedCommit

FOLDER = "carried"

SERVERS_OWN = (OPERATOR, INITIAL)
"""Authors in whose name servers speak, by keys that only a server knows whether to trust."""
ATTACHMENTS_SHARE = 4
"""A quarter of the folder's room is for attachments of marks."""
ATTACHMENTS_BYTES_MAX = 1 << 32


class CarriedCommits:
    """A folder of commits as one end of a relay (`relay_peer.MapEnd`); for one program at a time."""

    def __init__(self, folder: Path, map_name: str, *, size_bytes_max: int) -> None:
        """Open or make the folder; for commits of this map.

        Raises:
            BadInputError: kind `bad_folder`.
        """
        self._folder = folder
        self._map_name = map_name
        self._size_bytes_max = size_bytes_max
        self._attachments = AttachmentFolder(
            folder / ATTACHMENTS, size_bytes_max=min(size_bytes_max // ATTACHMENTS_SHARE, ATTACHMENTS_BYTES_MAX)
        )
        try:
            folder.mkdir(0o700, parents=True, exist_ok=True)
        except OSError as exc:
            raise BadInputError("bad_folder", f"cannot make the folder {folder}: {exc.strerror}") from exc

    def held(self) -> Held:
        """Ids of the commits that are or were carried.

        Raises:
            UnreachableError: kind `store_failed`: the folder cannot be read.
        """
        try:
            return Held(vector=EMPTY.with_commits(commit for commit, _ in self._files()))
        except OSError as exc:
            raise UnreachableError("store_failed", f"cannot read {self._folder}: {exc.strerror}") from exc

    def commit(self, commit: CommitId) -> SignedCommit:
        """A commit that is carried."""
        try:
            signatures, _, data = (self._folder / str(commit)).read_bytes().partition(b"\n")
        except FileNotFoundError as exc:
            raise NotFoundError("no_commit", f"{commit} is not carried") from exc
        except OSError as exc:
            path = self._folder / str(commit)
            raise DamagedDataError("damaged_store", f"cannot read {path}: {exc.strerror}; remove it") from exc
        if not signatures:
            raise ConflictError("evidence_gone", f"there was no room to carry {commit} on")
        if len(signatures) > TEXT_MAX or not signatures.isascii():
            raise DamagedDataError("damaged_store", f"{self._folder / str(commit)} is damaged; remove it")
        return SignedCommit(commit, data, signatures.decode())

    def push(self, commit: SignedCommit) -> None:
        """Carry a commit; durable on return.

        Raises:
            BadInputError: not what its author signed: kept, it would keep the true one out; or larger than all room.
            DamagedDataError: no sound commit.
        """
        meta = self._check(commit)
        content = (commit.signatures or "").encode() + b"\n" + commit.data
        try:
            self._make_room(len(content))
            write_durable_file(self._folder / str(commit.id), content)
            for mark in meta.marks:
                if mark.attachment is not None:
                    self._attachments.await_one(mark.attachment)
        except OSError as exc:
            raise UnreachableError("store_failed", f"cannot write to {self._folder}: {exc.strerror}") from exc

    def has_attachments(self) -> bool:
        """True if any are here."""
        return bool(self._attachments.names())

    def wanted_attachments(self) -> list[Attachment]:
        """Attachments that carried marks name and that did not come here."""
        return self._attachments.awaited()

    def attachment(self, attachment: Attachment) -> bytes | None:
        """Bytes of an attachment; None if they are not here."""
        return self._attachments.read(attachment.sha256)

    def keep_attachment(self, attachment: Attachment, data: bytes) -> None:
        """Carry an attachment; the oldest ones give way to it."""
        self._attachments.make_room(len(data))
        self._attachments.keep(data)

    def _check(self, commit: SignedCommit) -> CommitMeta:
        size_bytes = len(commit.signatures or "") + 1 + len(commit.data)
        if size_bytes > self._size_bytes_max:
            raise BadInputError(
                "too_large", f"{commit.id} takes {size_bytes} bytes, and {self._folder} has {self._size_bytes_max}"
            )
        found = validated_commit(commit.data)
        if found.id != commit.id:
            raise BadInputError("other_id", f"came as {commit.id}, and is {found.id}")
        signed = signatures_from_text(commit.signatures or "")
        check_signatures(signed, self._map_name, found.sha)
        if commit.id.author.robot not in SERVERS_OWN and not speaks_for(signed, commit.id.author):
            raise BadInputError("bad_signature", f"{commit.id} is not signed by its author")
        return found.meta

    def _make_room(self, size_bytes: int) -> None:
        """Empty the oldest files until so many bytes fit."""
        found = sorted((path.stat().st_mtime_ns, path) for _, path in self._files())
        total = sum(path.stat().st_size for _, path in found) + size_bytes + self._attachments.size_bytes()
        for _, path in found:
            if total <= self._size_bytes_max:
                return
            total -= path.stat().st_size
            os.truncate(path, 0)

    def _files(self) -> Iterator[tuple[CommitId, Path]]:
        for path in self._folder.iterdir():
            try:
                yield commit_id_from_text(path.name), path
            except BadInputError:
                continue  # not whole, or somebody else's


class Carrier:
    """Commits of others that a robot carries: at each server it hands them over, and takes along what they lack."""

    def __init__(self, directory: Path, api: RelayApi, map_name: str, *, size_bytes_max: int) -> None:
        self._here = CarriedCommits(directory / FOLDER, map_name, size_bytes_max=size_bytes_max)
        self._there = ServerEnd(api, map_name)
        self._map_name = map_name
        self._resting = Undelivered()

    def exchange(self) -> RelayReport:
        """One round with the server that the robot is at.

        Raises:
            UnreachableError: the link broke; what was handed over stays so.
        """
        report = hold_between(relay_round(self._resting), self._here, self._there)
        log_report(report, self._map_name, there="the server")
        if not report.cut:
            hand_over_attachments(self._here, self._there)
        if report.cut:
            raise report.cut
        return report


def carrier_in(directory: Path, api: RelayApi, map_name: str, *, size_bytes_max: int) -> Carrier | None:
    """Carrier of a robot with so many bytes for others' commits; None if it has none."""
    return Carrier(directory, api, map_name, size_bytes_max=size_bytes_max) if size_bytes_max else None
