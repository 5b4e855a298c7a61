"""Processes that search many images at once; results come in the order of the images, whatever their number."""

import os
import signal
import threading
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context, parent_process

import cv2

from cairn_calib.corner_search.image_search import ImageTask, SearchedImage, search_image
from cairn_map.errors import ConflictError

AHEAD = 4
"""Images for each process that are searched or wait, while the first of them is not done yet."""


def search_images(tasks: Sequence[ImageTask], *, jobs: int) -> Iterator[SearchedImage]:
    """Outcomes of all images, in order, searched by as many processes as `jobs`.

    Raises:
        BadInputError: no image tells the first corner of this board.
        ConflictError: a process was ended from outside, as for lack of memory.
    """
    if jobs == 1 or len(tasks) == 1:
        yield from map(search_image, tasks)
        return
    with ProcessPoolExecutor(min(jobs, len(tasks)), mp_context=get_context("spawn"), initializer=_begin) as pool:
        waiting: deque[Future[SearchedImage]] = deque()
        try:
            for task in tasks:
                waiting.append(pool.submit(search_image, task))
                if len(waiting) == AHEAD * jobs:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        except BrokenProcessPool as exc:
            raise ConflictError(
                "worker_lost",
                "a process that searched images was ended from outside, as happens when memory runs out: "
                "run the same command again with --resume and fewer --jobs",
            ) from exc
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _begin() -> None:
    """Prepare a worker."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the main process says when to stop
    threading.Thread(target=_end_with_parent, daemon=True).start()
    cv2.setNumThreads(1)  # the other processes use the other cores


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)  # as a kill at any moment, which harms nothing
