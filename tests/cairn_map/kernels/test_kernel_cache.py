"""The law of the kernel cache: whatever its folders are like, a kernel gives its result and raises nothing of theirs.

Where one of them can be written, the next process does not compile it again; a folder that cannot be written is read.
"""

import importlib.util
import itertools
import logging
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType

import numba
import pytest

from cairn_map.kernels import kernel_cache
from cairn_map.kernels.kernel_cache import (
    KernelCache,
    digest,
    drop_other_versions,
    forget_kernels,
    is_warm,
    kept_folder,
    mark_warm,
)

SOURCE = """
import numba

@numba.njit
def doubled(x):
    return 2 * x
"""
_names = (f"made_{n}" for n in itertools.count())


@pytest.fixture
def folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Path, Path]]:
    """Folders of kernels: the first, and the spare one."""
    first, spare = tmp_path / "first", tmp_path / "spare"
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(first))
    monkeypatch.setattr(kernel_cache._Spare, "folder", spare)
    monkeypatch.setattr(kernel_cache._Spare, "has_failed", False)
    yield first, spare
    kernel_cache._may_write.cache_clear()


@pytest.fixture
def source(tmp_path: Path) -> Path:
    path = tmp_path / "made_kernels.py"
    path.write_text(SOURCE)
    return path


def used(source: Path) -> int:
    """Compilations that one more process would need to call the kernel."""
    kernel_cache._may_write.cache_clear()
    spec = importlib.util.spec_from_file_location(next(_names), source)
    assert spec is not None and spec.loader is not None
    module: ModuleType = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.doubled._cache = KernelCache(module.doubled.py_func)
    assert module.doubled(21) == 42
    return sum(module.doubled.stats.cache_misses.values())


def test_a_kernel_is_compiled_once(folders: tuple[Path, Path], source: Path) -> None:
    assert [used(source), used(source)] == [1, 0]
    assert list(folders[0].rglob("*.nbi")) and not folders[1].exists()


def in_the_way(folder: Path) -> None:
    folder.write_text("a file, where a folder should be")


def damaged(folder: Path, name: str, change: Callable[[bytes], bytes]) -> None:
    for path in folder.rglob(name):
        path.write_bytes(change(path.read_bytes()))


@pytest.mark.parametrize(
    "change", [lambda data: b"", lambda data: data[: len(data) // 2], lambda data: b"\x80" + data[1:][::-1]]
)
@pytest.mark.parametrize("name", ["*.nbi", "*.nbc"])
def test_damaged_files_are_compiled_and_kept_again(
    folders: tuple[Path, Path], source: Path, name: str, change: Callable[[bytes], bytes]
) -> None:
    assert used(source) == 1
    damaged(folders[0], name, change)
    assert [used(source), used(source)] == [1, 0]


def test_where_the_first_folder_takes_nothing_the_spare_one_does(folders: tuple[Path, Path], source: Path) -> None:
    first, spare = folders
    in_the_way(first)
    assert [used(source), used(source)] == [1, 0]
    assert list((spare / digest()).rglob("*.nbi"))


def test_without_any_folder_each_process_compiles(folders: tuple[Path, Path], source: Path) -> None:
    for folder in folders:
        in_the_way(folder)
    assert kept_folder() is None
    assert [used(source), used(source)] == [1, 1]


def test_a_folder_that_turns_out_to_be_full_is_said_once(
    folders: tuple[Path, Path], source: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def full(path: Path, *_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "mkdir", full)
    with caplog.at_level(logging.WARNING):
        assert [used(source), used(source)] == [1, 1]
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert "No space left on device" in caplog.text


def test_kernels_of_another_version_are_forgotten_once(folders: tuple[Path, Path]) -> None:
    """A kernel holds code of those that it calls, so that one of the version before would be wrong."""
    source = next(path for path in kernel_cache._sources("cairn_map") if path.stem == "morton_kernels")
    kept = kernel_cache._first_part(source) / "morton_kernels.interleave-40.py311.nbi"
    kept.parent.mkdir(parents=True)
    for there in (False, True):
        kept.touch()
        forget_kernels("cairn_map")
        assert kept.exists() is there


def test_other_versions_leave_the_spare_folder(folders: tuple[Path, Path]) -> None:
    first, spare = folders
    in_the_way(first)
    for name in (digest(), "0123456789abcdef"):
        (spare / name).mkdir(parents=True)
    mark_warm("cairn_map")
    drop_other_versions()
    assert [path.name for path in spare.iterdir()] == [digest()]
    assert is_warm("cairn_map")
