"""Processes that reprocess robots' folders, one folder each at a time; with a single one, this process itself.

    main process     plans of all folders, then their reports; a bar of the measurements that are done
    each worker      one folder after the other; it counts its measurements in an array that all share

A worker ends with the main process, however that ends, so that the folder is free for the next try. It is started
afresh (`spawn`), since threads and locks do not survive a fork.
"""

import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager
from ctypes import c_uint64
from multiprocessing import get_context, parent_process
from multiprocessing.sharedctypes import RawArray
from pathlib import Path
from typing import TYPE_CHECKING

from cairn_client.folders.reprocessing import FolderPlan, FolderReport, Recipe, plan_of, reprocess
from cairn_fusion.warm_up import warm_up
from cairn_map.errors import CairnError, UnreachableError
from cairn_map.kernels.numba_runtime import is_compiled, keep_interrupts_out_of_kernels, known_kernels, show_compiling
from cairn_map.progress import with_progress

if TYPE_CHECKING:
    from ctypes import Array

LOOK_EVERY_S = 0.2
"""Pause between two looks at how far the workers are."""
LOST = UnreachableError(
    "worker_lost",
    "a process was killed, perhaps because the memory was short; what is done stays done: run the same command again, "
    "with fewer --jobs",
)


class FolderWorkers:
    """Workers for the folders of one command."""

    def __init__(
        self, folders: Sequence[Path], recipe: Recipe, pool: ProcessPoolExecutor | None, done: "Array[c_uint64]"
    ) -> None:
        """Args: pool: None: this process; done: measurements done in each folder, and a last number: 1 means stop."""
        self._folders = folders
        self._recipe = recipe
        self._pool = pool
        self._done = done

    def plans(self) -> list[FolderPlan]:
        """Plans of all folders; raises what `plan_of` does of the first one that cannot be planned."""
        if self._pool is None:
            return [plan_of(folder, self._recipe) for folder in self._folders]
        try:
            return list(self._pool.map(plan_of, self._folders, [self._recipe] * len(self._folders)))
        except BrokenProcessPool as exc:
            raise LOST from exc

    def reprocess(self, plans: Sequence[FolderPlan]) -> list[FolderReport]:
        """Reports of all folders, in their order; a folder whose work ended early says why."""
        total = sum(len(plan.to_amend) for plan in plans)
        results: list[Callable[[], FolderReport]] = []
        ticks = self._ticks_here(results) if self._pool is None else self._ticks_of(self._pool, results)
        for _ in with_progress(ticks, "reprocess", total=total) if total else ticks:
            pass
        return [_report(result, plan) for result, plan in zip(results, plans, strict=True)]

    def _ticks_here(self, results: list[Callable[[], FolderReport]]) -> Iterator[None]:
        """One None for each measurement that is done; the results are appended."""
        for folder in self._folders:
            future = Future[FolderReport]()
            results.append(future.result)
            tried = 0
            try:
                reports = reprocess(folder, self._recipe)
                report = next(reports)
                for report in reports:
                    yield from [None] * (report.tried - tried)
                    tried = report.tried
                future.set_result(report)
            except CairnError as exc:
                future.set_exception(exc)

    def _ticks_of(self, pool: ProcessPoolExecutor, results: list[Callable[[], FolderReport]]) -> Iterator[None]:
        futures = [pool.submit(_work, index, folder, self._recipe) for index, folder in enumerate(self._folders)]
        results += [future.result for future in futures]
        left, before = set(futures), 0
        while left:
            left = wait(left, timeout=LOOK_EVERY_S).not_done
            done = sum(self._done[:-1])
            yield from [None] * (done - before)
            before = done


@contextmanager
def folder_workers(folders: Sequence[Path], recipe: Recipe, *, jobs: int) -> Iterator[FolderWorkers]:
    """Workers for these folders, as many as `jobs`; on ^C each ends its measurement, and starts no other."""
    done = RawArray(c_uint64, len(folders) + 1)
    if jobs == 1:
        yield FolderWorkers(folders, recipe, None, done)
        return
    # Each worker would compile all kernels of its own, at the same time.
    if not all(is_compiled(kernel) for kernel in known_kernels()):
        warm_up()
    context = get_context("spawn")
    with ProcessPoolExecutor(jobs, mp_context=context, initializer=_begin, initargs=(done,)) as pool:
        try:
            yield FolderWorkers(folders, recipe, pool, done)
        except BaseException:
            done[len(folders)] = 1
            pool.shutdown(wait=False, cancel_futures=True)
            raise


_shared: "list[Array[c_uint64]]" = []
"""The array that this worker shares with all others."""


def _begin(done: "Array[c_uint64]") -> None:
    """Prepare a worker."""
    _shared.append(done)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the main process says when to stop
    threading.Thread(target=_end_with_parent, daemon=True).start()
    show_compiling()
    keep_interrupts_out_of_kernels()


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)  # as a kill at any moment, which harms nothing


def _work(index: int, folder: Path, recipe: Recipe) -> FolderReport:
    """Reprocess one folder in a worker."""
    (done,) = _shared
    with closing(reprocess(folder, recipe)) as reports:
        report = next(reports)
        for report in reports:
            done[index] = report.tried
            if done[len(done) - 1]:
                break
    return report


def _report(result: Callable[[], FolderReport], plan: FolderPlan) -> FolderReport:
    try:
        return result()
    except BrokenProcessPool:
        return FolderReport(plan=plan, stopped=LOST)
    except CairnError as exc:
        return FolderReport(plan=plan, stopped=exc)
