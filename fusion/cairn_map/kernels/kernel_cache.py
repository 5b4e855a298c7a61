"""Kernel cache: compiled kernels on disk, read where they are and written where that is allowed.

    $NUMBA_CACHE_DIR where it is set, else __pycache__ next to the sources
    the spare folder (of a server: DIR/kernels; else ~/.cache/cairn)           where the first takes no writing

Numba reads no folder that it may not write to, and refuses to import a kernel where it may write to none: a service
user without a home, whose code is read-only, could not start. Here a cache is never the reason why a program fails:
what cannot be read is compiled, and what cannot be written is compiled again by the next process.

A kernel holds the code of those that it calls, and Numba keeps it by its own file alone. So folders of their own have
a digest of all sources in their name, and a read-only one counts only if a mark says that it was completed by these
very sources, this Python, this Numba and this processor.
"""

import fcntl
import hashlib
import logging
import os
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache, cached_property
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path
from types import FunctionType
from typing import Any

import numba
from llvmlite import binding
from numba.core import ccallback, config, dispatcher
from numba.core.caching import CompileResultCacheImpl, FunctionCache, IndexDataCacheFile, InTreeCacheLocator

log = logging.getLogger(__name__)

WARM_UPS = "cairn.warm_up"
"""Entry points of the packages that have kernels."""
DIGEST_LENGTH = 16


class _Spare:
    """The spare folder of this program; None: there is none."""

    folder: Path | None = None
    has_failed = False
    """True once it was logged that a kernel could not be kept."""


def keep_kernels(spare: Path | None) -> None:
    """Keep compiled kernels from now on, in the spare folder where need be; before the first kernel is imported.

    A later call names another spare folder, which counts for kernels that were not called yet.
    """
    _Spare.folder = spare
    dispatcher.FunctionCache = KernelCache  # type: ignore[attr-defined]
    ccallback.FunctionCache = KernelCache  # type: ignore[attr-defined]


def home_folder() -> Path | None:
    """Spare folder of programs that have no folder of their own; None: this user has no home."""
    with suppress(RuntimeError):
        return Path("~/.cache/cairn").expanduser()
    return None


def spare_folder() -> Path | None:
    """Spare folder of this program."""
    return _Spare.folder


def kept_folder() -> Path | None:
    """Folder that takes kernels compiled from now on; None: no folder may be written to."""
    return next((folder for folder in (_first_folder(), _own_spare()) if folder and _may_write(folder)), None)


def is_warm(package: str) -> bool:
    """True if all that a package's warm-up calls is kept, compiled from these sources for this processor."""
    return any(folder is not None and _mark(folder, package).exists() for folder in (_first_folder(), _own_spare()))


def mark_warm(package: str) -> None:
    """Note that all that a package's warm-up calls is kept."""
    folder = kept_folder()
    if folder is None:
        return
    with _errors_logged():
        folder.mkdir(parents=True, exist_ok=True)
        _mark(folder, package).touch()


def drop_other_versions() -> None:
    """Remove kernels of other versions from the spare folder, which one program alone has."""
    spare = _Spare.folder
    if spare is not None and spare.is_dir():
        for other in spare.iterdir():
            if other.name != digest():
                shutil.rmtree(other, ignore_errors=True)


def forget_kernels(package: str) -> None:
    """Remove a package's kernels from the first place, once for each version: another one may have left them there."""
    folder = _first_folder()
    begun = _mark(folder, f"{package}.begun")
    if begun.exists() or not _may_write(folder):
        return
    with _errors_logged():
        for source in _sources(package):
            for path in _first_part(source).glob(f"{source.stem}.*.nb[ic]"):
                path.unlink(missing_ok=True)
        folder.mkdir(parents=True, exist_ok=True)
        begun.touch()


@cache
def digest() -> str:
    """Digest of the sources of all kernels, and of what compiles them for which processor."""
    machine = (sys.version, numba.__version__, binding.get_host_cpu_name(), binding.get_host_cpu_features().flatten())
    sha = hashlib.sha256(repr(machine).encode())
    for package in sorted({point.value.partition(".")[0] for point in entry_points(group=WARM_UPS)}):
        for path in _sources(package):
            sha.update(f"{package} {path.name}\0".encode() + path.read_bytes())
    return sha.hexdigest()[:DIGEST_LENGTH]


def _sources(package: str) -> list[Path]:
    """Files of a package's kernels; none if it is not installed."""
    spec = find_spec(package)
    folders = (spec.submodule_search_locations if spec else None) or ()
    return sorted(path for folder in folders for path in Path(folder).rglob("*_kernels.py"))


class KernelCache:
    """Cache of one kernel, instead of Numba's; folders are looked for when it is first called, not when it is made."""

    def __init__(self, py_func: FunctionType) -> None:
        self._py_func = py_func
        self._is_enabled = True

    @property
    def cache_path(self) -> str:
        """Folder that has the kernel, else the one that would take it."""
        found = [each for each in self._read if each.index.exists()] or [each for each in (self._kept,) if each]
        return str((found or [self._first])[0].folder)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The compiled kernel for arguments of these types; None: it is in no folder, or damaged."""
        if not self._is_enabled:
            return None
        for each in self._read:
            try:
                found = each.load_overload(sig, target_context)  # type: ignore[no-untyped-call]
            except OSError:
                continue
            except Exception as exc:  # noqa: BLE001 - what a power cut left of a pickle raises anything
                log.warning("a compiled kernel in %s is damaged, and is compiled again: %r", each.folder, exc)
                if each is self._kept:
                    with suppress(OSError):
                        each.flush()  # type: ignore[no-untyped-call]
            else:
                if found is not None:
                    return found
        return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep the compiled kernel, where that is allowed and there is room."""
        if not self._is_enabled or self._kept is None:
            return
        with _errors_logged():
            self._kept.folder.mkdir(parents=True, exist_ok=True)
            with _locked(self._kept.folder):
                self._kept.save_overload(sig, data)  # type: ignore[no-untyped-call]

    def enable(self) -> None:
        """Use the cache."""
        self._is_enabled = True

    def disable(self) -> None:
        """Use it no more."""
        self._is_enabled = False

    def flush(self) -> None:
        """Forget what is kept."""
        if self._kept is not None:
            self._kept.flush()  # type: ignore[no-untyped-call]

    @cached_property
    def _first(self) -> "_FolderCache":
        return _FolderCache(self._py_func, _first_part(Path(self._py_func.__code__.co_filename)))

    @cached_property
    def _spare(self) -> "_FolderCache | None":
        folder = _own_spare()
        part = _part_of(Path(self._py_func.__code__.co_filename))
        return _FolderCache(self._py_func, folder / part) if folder else None

    @cached_property
    def _kept(self) -> "_FolderCache | None":
        return next((each for each in (self._first, self._spare) if each and _may_write(each.folder)), None)

    @cached_property
    def _read(self) -> "list[_FolderCache]":
        """Folders that are looked into, in this order."""
        package = self._py_func.__module__.partition(".")[0]
        first = [self._first] if self._first is self._kept or _mark(_first_folder(), package).exists() else []
        return first + ([self._spare] if self._spare else [])


class _Locator(InTreeCacheLocator):
    """Numba's locator of a kernel's source, which writes nothing to find out whether it may."""

    def ensure_cache_path(self) -> None:
        pass


class _Impl(CompileResultCacheImpl):
    """Numba's form of compiled kernels."""

    _locator_classes = [_Locator]  # noqa: RUF012 - as in Numba


class _FolderCache(FunctionCache):
    """Numba's cache of one kernel in a folder."""

    _impl_class = _Impl

    def __init__(self, py_func: FunctionType, folder: Path) -> None:
        super().__init__(py_func)  # type: ignore[no-untyped-call]
        self.folder = folder
        name, stamp = self._impl.filename_base, self._impl.locator.get_source_stamp()
        self.index = folder / f"{name}.nbi"
        self._cache_path = str(folder)
        self._cache_file = IndexDataCacheFile(str(folder), name, stamp)  # type: ignore[no-untyped-call]


def _named_folder() -> Path | None:
    named: str = config.CACHE_DIR  # type: ignore[attr-defined]
    return Path(named) if named else None


def _first_folder() -> Path:
    """Folder of the mark of the first place."""
    return _named_folder() or Path(__file__).parent / "__pycache__"


def _own_spare() -> Path | None:
    return _Spare.folder and _Spare.folder / digest()


def _part_of(source: Path) -> str:
    """Numba's own name for a source's folder within `NUMBA_CACHE_DIR`: a program without this cache reads it, too."""
    name: str = _Locator.get_suitable_cache_subpath(str(source))  # type: ignore[no-untyped-call]
    return name


def _first_part(source: Path) -> Path:
    """Folder of a source's kernels in the first place."""
    named = _named_folder()
    return source.parent / "__pycache__" if named is None else named / _part_of(source)


def _mark(folder: Path, package: str) -> Path:
    return folder / f"{package}-{digest()}"


@cache
def _may_write(folder: Path) -> bool:
    there = next(path for path in (folder, *folder.parents) if path.exists())
    return there.is_dir() and os.access(there, os.W_OK | os.X_OK)


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """A folder for this process alone: a kernel's index is read, changed and written."""
    number = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(number, fcntl.LOCK_EX)
        yield
    finally:
        os.close(number)


@contextmanager
def _errors_logged() -> Iterator[None]:
    """Log why a kernel is not kept, once a process, and go on."""
    try:
        yield
    except Exception as exc:  # noqa: BLE001 - a full disk, or a damaged index
        if not _Spare.has_failed:
            _Spare.has_failed = True
            log.warning("compiled kernels are not kept, and each process compiles its own: %s", exc)
