"""Scans of the newest measurements, kept on disk up to a number of bytes, so that their poses can be corrected.

    scans/open.partial                                the scans of the open measurement, as they come
    scans/000042.mole.0123456789abcdef.7.scans        those of commit 7, the 42nd file; the lowest number goes first

A file is a row of scans (`scan_bytes`), each behind its length. It is written once, from its beginning to its end, and
never flushed by force: that would wear the flash of a robot for what only helps. A power cut may cost the scans of the
last half minute, which is noticed by their checksums, and never any evidence; so may a full disk. The commits of the
measurements that are kept stay in the outbox, so that an amend is seen at once.

Cost of `KeptScans.add` on one core: five cameras of full size (10 MB) 6.3 MB and 30 ms a scan, of a quarter of it 0.5
MB and 1.1 ms, a time-of-flight camera of 176 x 144 pixels alone 0.14 MB and 0.2 ms. Amends write no scans.
"""

import logging
import re
import struct
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from cairn_fusion.recording.scan import Scan
from cairn_fusion.recording.scan_bytes import decode_scan, encode_scan
from cairn_map.commits.ids import CommitId, commit_id_from_text
from cairn_map.errors import BadInputError, DamagedDataError

log = logging.getLogger(__name__)

OPEN = "open.partial"
FILE_NAME = re.compile(r"([0-9]{6,})\.(.+)\.scans")
LENGTH = struct.Struct("<Q")


@dataclass(frozen=True, slots=True)
class ScanFile:
    """The scans of one measurement."""

    number: int
    commit: CommitId
    """Commit that the measurement became, or the last amend of it."""
    path: Path
    size_bytes: int


class KeptScans:
    """The newest measurements' scans in a folder of a robot; by one thread, but any may ask for `commits`."""

    def __init__(self, folder: Path, *, bytes_max: int) -> None:
        """Look at what is kept; nothing is written before the first scan comes, and with 0 bytes nothing at all.

        Raises:
            BadInputError: a negative number of bytes, or the folder cannot be read.
        """
        if bytes_max < 0:
            raise BadInputError("bad_option", f"kept scans take 0 bytes or more, got {bytes_max}")
        self._folder = folder
        self.bytes_max = bytes_max
        self._open: BinaryIO | None = None
        self._open_bytes = 0
        self._is_given_up = False
        """True if the scans of the open measurement are not kept."""
        # Replaced whole at each change, because the thread that syncs asks which commits are in it.
        self._files: dict[CommitId, ScanFile] = {}
        try:
            self._files = _files_in(folder) if folder.is_dir() else {}
        except OSError as exc:
            raise BadInputError("bad_folder", f"cannot read {folder}: {exc.strerror}") from exc

    @property
    def size_bytes(self) -> int:
        """Bytes of the scans that are kept, the open measurement included."""
        return sum(file.size_bytes for file in self._files.values()) + self._open_bytes

    @property
    def commits(self) -> list[CommitId]:
        """Commits whose scans are kept, oldest measurement first."""
        return [file.commit for file in self._files.values()]

    def add(self, scan: Scan) -> None:
        """Keep a scan of the open measurement; a scan that cannot be kept is logged, and is no failure."""
        if not self.bytes_max or self._is_given_up:
            return
        data = encode_scan(scan)
        record = LENGTH.pack(len(data)) + data
        if self._open_bytes + len(record) > self.bytes_max:
            log.warning("one measurement's scans need more than %d bytes; they are not kept", self.bytes_max)
            self._forget_open(is_given_up=True)
            return
        try:
            self._make_room(len(record))
            if self._open is None:
                self._folder.mkdir(parents=True, exist_ok=True)
                self._open = (self._folder / OPEN).open("wb")
            self._open.write(record)
            self._open_bytes += len(record)
        except OSError as exc:
            log.warning("the scans of this measurement are not kept: %s", exc.strerror)
            self._forget_open(is_given_up=True)

    def close_measurement(self, commit: CommitId) -> None:
        """Note that the open measurement became this commit."""
        if self._open is not None:
            number = max((file.number for file in self._files.values()), default=0) + 1
            path = self._folder / f"{number:06d}.{commit}.scans"
            try:
                self._open.close()
                (self._folder / OPEN).replace(path)
                self._files = {**self._files, commit: ScanFile(number, commit, path, self._open_bytes)}
            except OSError as exc:
                log.warning("the scans of commit %s are not kept: %s", commit, exc.strerror)
            self._open, self._open_bytes = None, 0
        self._is_given_up = False

    def rename(self, commit: CommitId, new: CommitId) -> None:
        """Note that the scans of a commit are those of its amend now."""
        file = self._files[commit]
        path = self._folder / f"{file.number:06d}.{new}.scans"
        try:
            file.path.replace(path)
        except OSError as exc:
            log.warning("commit %s cannot be amended once more after a restart: %s", new, exc.strerror)
            path = file.path
        files = [ScanFile(file.number, new, path, file.size_bytes) if f is file else f for f in self._files.values()]
        self._files = {f.commit: f for f in files}

    def drop_measurement(self) -> None:
        """Forget the scans of the open measurement."""
        self._forget_open(is_given_up=False)

    def scans(self, commit: CommitId) -> Iterator[Scan]:
        """The scans of a commit, in order, read one by one.

        Raises:
            DamagedDataError: a power cut or the disk damaged them.
        """
        path = self._files[commit].path
        with path.open("rb") as file:
            while length := file.read(LENGTH.size):
                if len(length) < LENGTH.size:
                    raise DamagedDataError("damaged_scan", f"{path} ends early")
                (size,) = LENGTH.unpack(length)
                yield decode_scan(file.read(min(size, self._files[commit].size_bytes)))

    def why_gone(self) -> str:
        """Reason why scans are not kept, with what to do about it."""
        if not self.bytes_max:
            return "this robot keeps none; open it with keep_scans_bytes=2_000_000_000, say, before it observes them"
        held = f"the newest {len(self._files)} measurements fill {self.size_bytes / 1e6:.1f} MB"
        return (
            f"{held} of {self.bytes_max / 1e6:.1f} MB, and older ones went; open the robot with larger keep_scans_bytes"
        )

    def _make_room(self, size_bytes: int) -> None:
        """Remove the oldest files until so many more bytes fit, or none is left."""
        while self._files and self.size_bytes + size_bytes > self.bytes_max:
            oldest = next(iter(self._files.values()))
            oldest.path.unlink(missing_ok=True)
            self._files = {commit: file for commit, file in self._files.items() if file is not oldest}

    def _forget_open(self, *, is_given_up: bool) -> None:
        opened, self._open = self._open, None
        self._open_bytes, self._is_given_up = 0, is_given_up
        if opened is not None:
            with suppress(OSError):  # on a full disk closing fails, too: it writes what is buffered
                opened.close()
            with suppress(OSError):
                (self._folder / OPEN).unlink(missing_ok=True)


def _files_in(folder: Path) -> dict[CommitId, ScanFile]:
    """The files of a folder, oldest first."""
    named = ((FILE_NAME.fullmatch(path.name), path) for path in folder.iterdir())
    found = []
    for match, path in named:
        if match:
            with suppress(BadInputError):  # somebody else's file
                found.append(ScanFile(int(match[1]), commit_id_from_text(match[2]), path, path.stat().st_size))
    return {file.commit: file for file in sorted(found, key=lambda file: file.number)}
