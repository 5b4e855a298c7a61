"""Stage of a demo: an empty folder for what it leaves, and a real server on a free port of this machine."""

import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from cairn_map.errors import BadInputError, UnreachableError

SERVER_STOP_S = 60.0
MARKER = "cairn-demo"


def empty_folder(folder: Path) -> None:
    """Make an empty folder; an older demo's is replaced, anything else is left alone.

    Raises:
        BadInputError: kind `not_empty`.
    """
    if folder.exists() and any(folder.iterdir()):
        if not (folder / MARKER).exists():
            raise BadInputError("not_empty", f"{folder} holds something else; choose another --output")
        shutil.rmtree(folder)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / MARKER).write_text("written by `cairn demo`, which replaces it when it runs again\n")


@contextmanager
def demo_server(folder: Path) -> Iterator[str]:
    """A server of its own process; its URL.

    Raises:
        UnreachableError: kind `no_server`: it did not start.
    """
    command = [sys.executable, "-m", "cairn_client.main", "serve", "--data", str(folder), "--port", "0"]
    with (folder.parent / "server.log").open("w") as log_file:
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log_file, text=True)  # noqa: S603
    try:
        line = process.stdout.readline() if process.stdout else ""
        found = re.search(r"http://\S+:\d+", line)
        if found is None:
            raise UnreachableError("no_server", f"the server did not start; see {folder.parent / 'server.log'}")
        yield found.group(0)
    finally:
        process.terminate()
        try:
            process.wait(timeout=SERVER_STOP_S)
        except subprocess.TimeoutExpired:  # what it acknowledged is durable
            process.kill()
            process.wait()
        if process.stdout:
            process.stdout.close()
