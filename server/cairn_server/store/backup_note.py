"""Note of a store's last backup: a file next to the store, which the backup's command writes and the server reads.

The file is in no backup, so a restored store has none until its own first backup.
"""

import json
import logging
import math
import os
import time
from pathlib import Path

from cairn_server.store.private_files import PRIVATE

log = logging.getLogger(__name__)

NOTE_NAME = "last-backup"


def note_backup(folder: Path, target: str, size_bytes: int) -> None:
    """Note that a folder's store was copied just now; a note that cannot be written does not undo the backup."""
    text = json.dumps({"time_s": round(time.time(), 3), "file": target, "size_bytes": size_bytes})
    try:
        descriptor = os.open(folder / NOTE_NAME, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, PRIVATE)
        with os.fdopen(descriptor, "w", encoding="utf-8") as file:
            file.write(f"{text}\n")
    except OSError as exc:
        log.warning("the backup is sound; the server's metrics do not know of it: %s", exc)


def backup_age_s(folder: Path, *, now_s: float) -> float:
    """Seconds since the last backup of a folder's store; infinite without any."""
    try:
        made_s = float(json.loads((folder / NOTE_NAME).read_text(encoding="utf-8"))["time_s"])
    except (OSError, ValueError, TypeError, KeyError):  # none, or one that a full disk cut short
        return math.inf
    return max(0.0, now_s - made_s)
