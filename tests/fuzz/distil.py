"""What a soak found, distilled: a few small inputs that reach the lines which the committed corpus does not.

    $ make soak
    $ python -m tests.fuzz.distil        # copies them from build/fuzz into the corpus

Lines of Python are counted, as the soak counts them; kernels again say nothing.
"""

import hashlib
import sys
from contextlib import suppress
from pathlib import Path
from types import FrameType
from typing import Any

from tests.fuzz.make_corpus import CORPUS, SUFFIX
from tests.fuzz.soak import BUILD
from tests.fuzz.targets import TARGETS, Target

from cairn_map.errors import CairnError

Lines = set[tuple[str, int]]

SIZE_BYTES_MAX = 2048
"""Of an input that is worth keeping for ever."""


def main() -> None:
    """Copy, and say how many."""
    for name, target in TARGETS.items():
        corpus = CORPUS / name
        known: Lines = set().union(*(lines_reached(target, path) for path in sorted(corpus.iterdir())))
        small = [path for path in (BUILD / "corpus" / name).glob("*") if path.stat().st_size <= SIZE_BYTES_MAX]
        kept = cover({path: lines_reached(target, path) for path in small}, known)
        for path in kept:
            data = path.read_bytes()
            (corpus / f"reached-{hashlib.sha256(data).hexdigest()[:8]}{SUFFIX}").write_bytes(data)
        sys.stdout.write(f"{name}: {len(kept)} more\n")


def cover(reached: dict[Path, Lines], known: Lines) -> list[Path]:
    """Few inputs that together reach all lines beside those known: each time the one that adds most, then smallest."""
    kept: list[Path] = []
    left = {path: lines - known for path, lines in reached.items()}
    while left := {path: lines for path, lines in left.items() if lines}:
        best = max(left, key=lambda path: (len(left[path]), -path.stat().st_size, path.name))
        kept.append(best)
        left = {path: lines - left[best] for path, lines in left.items()}
    return kept


def lines_reached(target: Target, path: Path) -> Lines:
    """File and number of each line of cairn that reading the input runs."""
    found: Lines = set()

    def local(frame: FrameType, event: str, _: object) -> Any:
        if event == "line":
            found.add((frame.f_code.co_filename, frame.f_lineno))
        return local

    def tracer(frame: FrameType, event: str, _: object) -> Any:
        return local if "/cairn_" in frame.f_code.co_filename else None

    sys.settrace(tracer)
    try:
        with suppress(CairnError):
            target.read(path.read_bytes())
    finally:
        sys.settrace(None)
    return found


if __name__ == "__main__":
    main()
