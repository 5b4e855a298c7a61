"""Compilers: processes that call a package's kernels once, each a part of them, so that all are compiled and kept.

Compiling holds the interpreter, so a server that compiled in its own process would not answer meanwhile; and a
kernel that is compiled is of use to all processes, for it is read from the cache.
"""

import os
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from types import TracebackType
from typing import Self

from cairn_map.kernels.program import command_of

SAID_MAX = 1000


class CompilersError(Exception):
    """A process failed; the message is the end of what it wrote."""


class Compilers:
    """Processes of a module's program, as many as processors, that share its parts (`cairn_map.warm_up.main`)."""

    def __init__(self, module: str, parts: Sequence[str]) -> None:
        count = min(len(parts), len(os.sched_getaffinity(0)))
        work, ends = os.pipe()
        os.write(ends, bytes(range(len(parts))))
        os.close(ends)
        # They write to this process, so that they end soon where it is killed.
        reading, writing = os.pipe()
        self._lines = os.fdopen(reading)
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - closed with this
        try:
            self._processes = [
                subprocess.Popen(  # noqa: S603 - our own program
                    command_of(module, parts), stdin=work, stdout=writing, stderr=self._errors
                )
                for _ in range(count)
            ]
        finally:
            os.close(work)
            os.close(writing)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.kill()
        self._lines.close()
        self._errors.close()

    def kernels(self) -> Iterator[str]:
        """Names of kernels as their turn comes, until all are compiled.

        Raises:
            CompilersError: a process failed, or was killed.
        """
        yield from (line.strip() for line in self._lines)
        codes = [process.wait() for process in self._processes]
        if any(codes):
            self._errors.seek(0)
            said = self._errors.read().decode(errors="replace").strip()[-SAID_MAX:]
            raise CompilersError(said or f"exit codes {codes}")

    def kill(self) -> None:
        """End the processes at once, from any thread: they can be killed at any instant."""
        for process in self._processes:
            process.kill()
        for process in self._processes:
            process.wait()
