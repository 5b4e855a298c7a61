"""Scans of the newest measurements, kept on disk up to a number of bytes, so that their poses can be corrected.

    scans/open.partial                                the scans of the open measurement, as they come
    scans/000042.mole.0123456789abcdef.7.scans        those of commit 7, the 42nd file; the lowest number goes first
    scans/4e9a...c1.rig.json                          a head that took some of them, by the digest that commits state

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

from cairn_calib.rig.rig import Rig, load_rig
from cairn_fusion.recording.scan import Scan
from cairn_fusion.recording.scan_bytes import decode_scan, encode_scan, read_images, read_time
from cairn_map.commits.ids import CommitId, commit_id_from_text
from cairn_map.errors import BadInputError, DamagedDataError

log = logging.getLogger(__name__)

OPEN = "open.partial"
RIG_SUFFIX = ".rig.json"
LOST_MAX = 256
"""Commits of which it is remembered why their scans are not kept."""
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
        self._given_up = ""
        """Reason why the scans of the open measurement are not kept; empty if they are."""
        self._lost: dict[CommitId, str] = {}
        """Reasons why scans of some commits were not kept, newest last."""
        self._rigs: dict[str, Rig] = {}
        """Heads that were read: each remembers the rays of its cameras, which take long to compute."""
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

    def add(self, scan: Scan, rig: Rig) -> None:
        """Keep a scan of the open measurement, and its head; one that cannot be kept is logged, and is no failure."""
        if not self.bytes_max or self._given_up:
            return
        data = encode_scan(scan)
        record = LENGTH.pack(len(data)) + data
        if self._open_bytes + len(record) > self.bytes_max:
            log.warning("one measurement's scans need more than %d bytes; they are not kept", self.bytes_max)
            self._forget_open("they alone are larger than keep_scans_bytes")
            return
        try:
            self._make_room(len(record))
            if self._open is None:
                self._folder.mkdir(parents=True, exist_ok=True)
                self.keep_rig(rig)
                self._open = (self._folder / OPEN).open("wb")
            self._open.write(record)
            self._open_bytes += len(record)
        except OSError as exc:
            log.warning("the scans of this measurement are not kept: %s", exc.strerror)
            self._forget_open(f"the disk did not take them ({exc.strerror})")

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
                self._note_lost(commit, f"the disk did not take them ({exc.strerror})")
            self._open, self._open_bytes = None, 0
        elif self._given_up:
            self._note_lost(commit, self._given_up)
        self._given_up = ""

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
        self._forget_open()

    def scans(self, commit: CommitId) -> Iterator[Scan]:
        """The scans of a commit, in order, read one by one.

        Raises:
            DamagedDataError: a power cut or the disk damaged them.
        """
        kept = self._files[commit]
        with kept.path.open("rb") as file:
            while (size := _next_size(file, kept)) is not None:
                yield decode_scan(file.read(size))

    def sample_scans(self, commit: CommitId) -> Iterator[Scan]:
        """One scan of a commit for each set of images that its scans have; of all others the images are not read.

        Raises:
            DamagedDataError: as `scans`.
        """
        kept, seen = self._files[commit], set()
        with kept.path.open("rb") as file:
            while (size := _next_size(file, kept)) is not None:
                start = file.tell()
                images = read_images(file)
                if images not in seen:
                    seen.add(images)
                    file.seek(start)
                    yield decode_scan(file.read(size))
                file.seek(start + size)

    def times_s(self, commit: CommitId) -> list[float]:
        """Times of a commit's scans, in order; images are not read.

        Raises:
            DamagedDataError: as `scans`.
        """
        kept, times_s = self._files[commit], []
        with kept.path.open("rb") as file:
            while (size := _next_size(file, kept)) is not None:
                start = file.tell()
                times_s.append(read_time(file))
                file.seek(start + size)
        return times_s

    def keep_rig(self, rig: Rig) -> None:
        """Keep a head, by its digest.

        Raises:
            OSError: the disk does not take it.
        """
        path = self._folder / f"{rig.digest()}{RIG_SUFFIX}"
        if not path.exists():
            partial = path.with_suffix(".partial")
            partial.write_bytes(rig.to_json())
            partial.replace(path)

    def rig(self, digest: str) -> Rig | None:
        """The head of that digest; None: it is not kept.

        Raises:
            BadInputError: the disk damaged it.
        """
        if digest not in self._rigs:
            path = self._folder / f"{digest}{RIG_SUFFIX}"
            if not path.exists():
                return None
            self._rigs[digest] = load_rig(path)
        return self._rigs[digest]

    def why_gone(self, commit: CommitId) -> str:
        """Reason why the scans of a commit are not kept, with what to do about it."""
        if commit in self._lost:
            return self._lost[commit]
        if not self.bytes_max:
            return "this robot keeps none; open it with keep_scans_bytes=2_000_000_000, say, before it observes them"
        held = f"the newest {len(self._files)} measurements fill {self.size_bytes / 1e6:.1f} MB"
        return (
            f"{held} of {self.bytes_max / 1e6:.1f} MB, and older ones went; open the robot with larger keep_scans_bytes"
        )

    def _note_lost(self, commit: CommitId, reason: str) -> None:
        self._lost[commit] = reason
        if len(self._lost) > LOST_MAX:
            del self._lost[next(iter(self._lost))]

    def _make_room(self, size_bytes: int) -> None:
        """Remove the oldest files until so many more bytes fit, or none is left."""
        while self._files and self.size_bytes + size_bytes > self.bytes_max:
            oldest = next(iter(self._files.values()))
            oldest.path.unlink(missing_ok=True)
            self._files = {commit: file for commit, file in self._files.items() if file is not oldest}

    def _forget_open(self, given_up: str = "") -> None:
        opened, self._open = self._open, None
        self._open_bytes, self._given_up = 0, given_up
        if opened is not None:
            with suppress(OSError):  # on a full disk closing fails, too: it writes what is buffered
                opened.close()
            with suppress(OSError):
                (self._folder / OPEN).unlink(missing_ok=True)


def _next_size(file: BinaryIO, kept: ScanFile) -> int | None:
    """Size of the scan that follows, at most that of the file; None at the end."""
    length = file.read(LENGTH.size)
    if not length:
        return None
    if len(length) < LENGTH.size:
        raise DamagedDataError("damaged_scan", f"{kept.path} ends early")
    return min(int(LENGTH.unpack(length)[0]), kept.size_bytes)


def _files_in(folder: Path) -> dict[CommitId, ScanFile]:
    """The files of a folder, oldest first."""
    named = ((FILE_NAME.fullmatch(path.name), path) for path in folder.iterdir())
    found = []
    for match, path in named:
        if match:
            with suppress(BadInputError):  # somebody else's file
                found.append(ScanFile(int(match[1]), commit_id_from_text(match[2]), path, path.stat().st_size))
    return {file.commit: file for file in sorted(found, key=lambda file: file.number)}
