"""A disk whose power goes: an apsw VFS below a real SQLite, which keeps what was not synced apart.

    xWrite      goes to the real file, where all connections see it, and into the list of what is not synced
    xSync       what is listed for this file is durable
    the cut     of each 512-byte sector any version since its last sync is left; of each file any size since then, of
                each name in the folder any file since the folder was synced; new sectors may hold rubbish

That is what POSIX allows, and more than most file systems do. SQLite syncs the folder when it first syncs a journal
or WAL that it made, and with some deletions. Writes and syncs are counted, so that the cut can fall on each.
"""

import random
import sys
import threading
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import apsw

SECTOR_BYTES = 512
JOURNALS = apsw.SQLITE_OPEN_MAIN_JOURNAL | apsw.SQLITE_OPEN_SUPER_JOURNAL | apsw.SQLITE_OPEN_WAL
Change = tuple[int, bytes | None]
"""Bytes at an offset; None: the file ends there."""


@dataclass(slots=True)
class Inode:
    """What of one file is on the platter, and what is not yet."""

    durable: bytearray = field(default_factory=bytearray)
    unsynced: list[Change] = field(default_factory=list)

    def sync(self) -> None:
        """All of it is durable."""
        for change in self.unsynced:
            apply(self.durable, change)
        self.unsynced.clear()

    def left_by_cut(self, rng: random.Random) -> bytes:
        """What may be left of it."""
        way = rng.choice(["nothing", "everything", "first", "any", "any", "any"])
        kept = {"nothing": 0, "first": rng.randint(0, len(self.unsynced))}.get(way, len(self.unsynced))
        content, sizes = bytearray(self.durable), [len(self.durable)]
        versions: dict[int, list[bytes]] = {}
        for change in self.unsynced[:kept]:
            at, data = change
            first, last = at // SECTOR_BYTES, (at + len(data or b"") - 1) // SECTOR_BYTES
            for sector in range(first, last + 1):
                versions.setdefault(sector, [self._sector(content, sector)])
            apply(content, change)
            sizes.append(len(content))
            for sector in range(first, last + 1):
                versions[sector].append(self._sector(content, sector))
        if way != "any":
            return bytes(content)
        left = bytearray(rng.choice(sizes))
        left[: len(self.durable)] = self.durable[: len(left)]
        for sector, found in versions.items():
            start = sector * SECTOR_BYTES
            if start < len(left):
                is_new = start >= len(self.durable)
                rubbish = [rng.randbytes(SECTOR_BYTES)] if is_new and rng.random() < 0.2 else []
                chosen = rng.choice([*found, *rubbish])
                end = min(start + len(chosen), len(left))
                left[start:end] = chosen[: end - start]
        return bytes(left)

    def _sector(self, content: bytearray, sector: int) -> bytes:
        return bytes(content[sector * SECTOR_BYTES : (sector + 1) * SECTOR_BYTES]).ljust(SECTOR_BYTES, b"\0")


def apply(content: bytearray, change: Change) -> None:
    """Write or cut off."""
    at, data = change
    content.extend(bytes(max(0, at - len(content))))
    if data is None:
        del content[at:]
    else:
        content[at : at + len(data)] = data


class Disk:
    """The files of one folder, until the power goes after so many writes and syncs."""

    def __init__(self, *, steps: int, failing: Iterable[int] = ()) -> None:
        self.lock = threading.RLock()
        self.steps_left = steps
        self.step = 0
        self.is_cut = False
        self._failing = set(failing)
        self._files: dict[Path, Inode] = {}
        self._names: dict[Path, list[Inode | None]] = {}
        """What each name stood for since the folder was synced last; None: for nothing."""

    def adopt(self, folder: Path) -> None:
        """What lies in a folder is durable."""
        for path in folder.iterdir():
            self._files[path] = Inode(bytearray(path.read_bytes()))
            self._names[path] = [self._files[path]]

    def take_step(self) -> None:
        """Count a write or sync; the one at which the power goes, and all after it, fail."""
        self.step += 1
        if self.step >= self.steps_left:
            self.is_cut = True
        self.check()
        if self.step in self._failing:
            raise apsw.IOError("the disk failed once")

    def check(self) -> None:
        """Fail if the power is gone."""
        if self.is_cut:
            raise apsw.IOError("the power is gone")

    def opened(self, path: Path) -> Inode:
        """The file of a name, made if there is none."""
        if path not in self._files:
            self._files[path] = Inode()
            self._names.setdefault(path, [None]).append(self._files[path])
        return self._files[path]

    def delete(self, path: Path) -> None:
        """The name stands for nothing any more."""
        if self._files.pop(path, None):
            self._names[path].append(None)

    def sync_folder(self) -> None:
        """What the names stand for now is durable."""
        self._names = {path: [self._files.get(path)] for path in self._names}

    def leave(self, folder: Path, rng: random.Random) -> None:
        """Write what the cut left into another folder."""
        for path, found in self._names.items():
            chosen = rng.choice(found)
            if chosen is not None:
                (folder / path.name).write_bytes(chosen.left_by_cut(rng))


class PowerVfs(apsw.VFS):
    """SQLite's own VFS on such a disk; the default one while it is entered."""

    def __init__(self, disk: Disk) -> None:
        self.disk = disk
        self._name, self._before = f"power-{id(self)}", apsw.vfs_names()[0]
        super().__init__(self._name, base=self._before)

    def __enter__(self) -> "PowerVfs":
        apsw.set_default_vfs(self._name)
        self._unraisable, sys.unraisablehook = sys.unraisablehook, self._note
        return self

    def __exit__(self, *error: object) -> None:
        apsw.set_default_vfs(self._before)
        self.unregister()
        sys.unraisablehook = self._unraisable

    def _note(self, failure: Any) -> None:
        """What SQLite has no way to tell its caller is known here."""
        if failure.exc_type is not apsw.IOError:
            self._unraisable(failure)

    def xOpen(self, name: Any, flags: list[int]) -> "PowerFile":
        """A file on the disk."""
        return PowerFile(self._before, name, flags, self.disk)

    def xDelete(self, filename: str, syncdir: bool) -> None:
        """A name fewer, and perhaps a folder that is synced; without power, nothing, and SQLite never cares."""
        with self.disk.lock:
            if self.disk.is_cut:
                return
            super().xDelete(filename, syncdir)
            self.disk.delete(Path(filename))
            if syncdir:
                self.disk.sync_folder()


class PowerFile(apsw.VFSFile):
    """One open file of it; temporary ones are left alone."""

    def __init__(self, base: str, name: Any, flags: list[int], disk: Disk) -> None:
        text = name.filename() if isinstance(name, apsw.URIFilename) else name
        self._disk = disk
        asked = flags[0]
        with disk.lock:
            disk.check()
            super().__init__(base, name, flags)
            self._inode = disk.opened(Path(text)) if text else None
        self._must_sync_folder = bool(asked & JOURNALS and asked & apsw.SQLITE_OPEN_CREATE)

    def xWrite(self, data: bytes, offset: int) -> None:
        """Seen by everybody, and not yet durable."""
        self._change((offset, bytes(data)), lambda: apsw.VFSFile.xWrite(self, data, offset))

    def xTruncate(self, size: int) -> None:
        """Seen by everybody, and not yet durable."""
        self._change((size, None), lambda: apsw.VFSFile.xTruncate(self, size))

    def xRead(self, amount: int, offset: int) -> bytes:
        """What everybody sees."""
        self._disk.check()
        return super().xRead(amount, offset)

    def xSync(self, flags: int) -> None:
        """What was written is durable; the real file need not be."""
        with self._disk.lock:
            self._disk.take_step()
            if self._inode:
                self._inode.sync()
            if self._must_sync_folder:
                self._disk.sync_folder()
                self._must_sync_folder = False

    def _change(self, change: Change, really: Any) -> None:
        with self._disk.lock:
            self._disk.take_step()
            really()
            if self._inode:
                self._inode.unsynced.append(change)
