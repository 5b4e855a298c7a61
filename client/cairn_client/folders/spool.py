"""Spool: a folder into which a driver puts recordings, and a robot's progress with each of them.

    spool/
      0001/  rig.json trajectory.txt tof.txt images/... recording.json     whole: recording.json is written last
      0002/  rig.json trajectory.txt ...                                   still being written

They are mapped in the order of their names; names with a dot in front are not looked at. What is done is remembered in
the same transaction as the commit, so that a measurement counts once, whenever the power is cut. A name may come again
with another recording, whose first scan has another time.
"""

import logging
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from pydantic import BaseModel, ConfigDict

from cairn_client.replica.replica import Replica
from cairn_client.replica.replica_schema import translate_damage
from cairn_fusion.mapping.grouping import Grouping, measurements_by
from cairn_fusion.recording.recording import Recording, open_recording
from cairn_fusion.recording.recording_format import HEADER_FILE, MEASUREMENTS_FILE
from cairn_map.errors import BadInputError, DamagedDataError

log = logging.getLogger(__name__)

GOING = ".going"
"""Ends the name, behind a dot, of a recording that is being deleted: whole or not, it is looked at no more."""
Stamp = tuple[int, int]
"""Identity of a recording's header file: its inode, and the time when it was written, ns."""


class SpoolMark(BaseModel):
    """Progress of the mapping of a recording."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    first_s: float
    """Time of its first scan, UTC: another recording may come under an old name."""
    stops: int
    """Measurements that are commits, or gave no evidence; of a recording that groups nothing, their scans."""
    is_done: bool
    left_out: int = 0
    """Number of these measurements of which no commit can be made; a recording with one is not deleted."""


@dataclass(frozen=True, slots=True)
class Stop:
    """A measurement of a recording, to be mapped."""

    folder: Path
    source: Recording
    scans: range
    """Indices in the recording."""
    done: int
    """Measurements, or scans, of the recording that are done with this one; see `SpoolMark.stops`."""
    left_out: int
    """Measurements before it that were left out."""

    @property
    def name(self) -> str:
        """The measurement, for messages."""
        return f"scans {self.scans.start} to {self.scans.stop - 1} of {self.folder}"

    def mark(self) -> Mapping[str, str]:
        """Texts to remember when the measurement is done."""
        return self._mark(left_out=self.left_out)

    def mark_left_out(self) -> Mapping[str, str]:
        """Texts to remember when no commit can be made of the measurement."""
        return self._mark(left_out=self.left_out + 1)

    def _mark(self, *, left_out: int) -> Mapping[str, str]:
        is_done = self.scans.stop == len(self.source)
        mark = SpoolMark(first_s=self.source.files[0].time_s, stops=self.done, is_done=is_done, left_out=left_out)
        return {_key(self.folder): mark.model_dump_json()}


class Spool:
    """A folder of recordings that come and go, without the robot that maps them."""

    def __init__(self, folder: Path) -> None:
        """Raises: BadInputError: kind `no_spool`: there is no such folder, or it is a recording itself."""
        if not folder.is_dir():
            raise BadInputError("no_spool", f"there is no folder {folder} for recordings to come into; make it")
        if (folder / HEADER_FILE).exists():
            raise BadInputError(
                "no_spool", f"{folder} is a recording, and a spool holds recordings; `cairn robot replay` maps one"
            )
        self._folder = folder
        self._settled: dict[Path, tuple[Stamp, float | None]] = {}
        """Stamp of each folder that is done, with the time of its first scan; None: no recording."""
        self._begin_badly: dict[Path, Stamp] = {}
        """Recordings whose first scan is damaged, as the log said."""

    def next_recording(self) -> Recording | None:
        """First recording that is whole and begins with a sound scan; None if there is none yet."""
        for path, stamp in self._whole():
            source = self._opened(path, stamp)
            if source is not None and self._begins_well(path, stamp, source):
                return source
        return None

    def stops(self, replica: Replica) -> Iterator[Stop]:
        """Measurements that are not mapped yet, of the recordings that are whole now."""
        for path, stamp in self._whole():
            source = self._opened(path, stamp)
            if source is None:
                continue
            first_s = source.files[0].time_s
            mark = _mark(replica, path, first_s)
            if not mark.is_done:
                for scans, done in _left(path, source, mark.stops):
                    yield Stop(path, source, scans, done, _mark(replica, path, first_s).left_out)
            self._settled[path] = stamp, first_s

    def delete_done(self, replica: Replica) -> None:
        """Delete the recordings that `stops` found mapped to their end, and forget them."""
        for path in self._folder.glob(f".*{GOING}"):  # the power was cut
            shutil.rmtree(path)
        for path, (stamp, first_s) in sorted(self._settled.items()):
            mark = _mark(replica, path, first_s) if first_s is not None else None
            if mark is None or not mark.is_done or mark.left_out or _stamp(path) != stamp:
                continue
            going = path.with_name(f".{path.name}{GOING}")
            path.rename(going)  # the driver may use the name again at once
            shutil.rmtree(going)
            remember(replica, {_key(path): None})
            del self._settled[path]

    def _whole(self) -> list[tuple[Path, Stamp]]:
        """Recordings that are not settled, in order."""
        found = (path for path in sorted(self._folder.iterdir()) if not path.name.startswith("."))
        stamped = [(path, stamp) for path in found if (stamp := _stamp(path)) is not None]
        return [(path, stamp) for path, stamp in stamped if self._settled.get(path, (None, None))[0] != stamp]

    def _begins_well(self, path: Path, stamp: Stamp, source: Recording) -> bool:
        """True if the first scan, which says what there is to map, can be read; the others may be sound anyway."""
        if self._begin_badly.get(path) == stamp:
            return False
        try:
            source.scan(0)
        except (BadInputError, DamagedDataError) as exc:
            log.error("%s cannot be the first recording of a map: %s", path, exc.message)
            self._begin_badly[path] = stamp
            return False
        return True

    def _opened(self, path: Path, stamp: Stamp) -> Recording | None:
        try:
            source = open_recording(path)
        except (BadInputError, DamagedDataError) as exc:
            log.error("%s is left out: %s", path, exc.message)
            self._settled[path] = stamp, None
            return None
        if not len(source):
            self._settled[path] = stamp, None
            return None
        return source


def _left(folder: Path, source: Recording, done: int) -> Iterator[tuple[range, int]]:
    """Scans of each measurement that is not done, with the count that is done after it.

    Where the recording groups nothing, scans are grouped by `Grouping`, from the first that is not done; so the count
    is of scans, as it was when each scan was a measurement.
    """
    if (folder / MEASUREMENTS_FILE).exists():
        yield from ((stop, number) for number, stop in enumerate(source.measurements()[done:], done + 1))
        return
    left = [(entry.time_s, entry.T_map_rig) for entry in source.files[done:]]
    for group in measurements_by(Grouping(), left):
        yield range(done + group.start, done + group.stop), done + group.stop


def remember(replica: Replica, texts: Mapping[str, str | None]) -> None:
    """Keep texts by key in a robot's folder, durably; None removes one."""
    with replica.store.transaction():
        for key, text in texts.items():
            replica.store.put(key, text)


def _stamp(folder: Path) -> Stamp | None:
    """Stamp of a recording; None if it is none, or not whole."""
    try:
        found = (folder / HEADER_FILE).stat()
    except (FileNotFoundError, NotADirectoryError):
        return None
    return found.st_ino, found.st_mtime_ns


def _mark(replica: Replica, folder: Path, first_s: float) -> SpoolMark:
    """SpoolMark of the recording that begins at this time; another one's, under the same name, does not count."""
    text = replica.store.get(_key(folder))
    with translate_damage(replica.store.file):
        mark = SpoolMark.model_validate_json(text) if text else None
    return mark if mark is not None and mark.first_s == first_s else SpoolMark(first_s=first_s, stops=0, is_done=False)


def _key(folder: Path) -> str:
    return f"spool/{folder.name}"
