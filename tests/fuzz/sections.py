"""Several files in one input: `=== NAME`, a line break, and the file, again and again.

=== trajectory.txt
0.0 1 2 3 0 0 0 1
=== images/0.png
...
"""

import random
import re
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from tests.fuzz.json_mutator import mutated_json
from tests.fuzz.png_mutator import SIGNATURE, mutated_png

Section = tuple[str, bytes]

MARK = b"\n=== "
FILE_NAME = re.compile(r"[A-Za-z0-9_.-]{1,40}(/[A-Za-z0-9_.-]{1,40})?")
MEMORY = Path("/dev/shm")
"""A file system without a disk, where there is one."""


def sections_of(data: bytes) -> list[Section]:
    """Names and contents, in order; what stands before the first name is left out."""
    found: list[Section] = []
    for part in (b"\n" + data).split(MARK)[1:]:
        name, _, content = part.partition(b"\n")
        found.append((name.decode("latin-1"), content))
    return found


def joined(sections: Sequence[Section]) -> bytes:
    """The mirror of `sections_of`."""
    return b"".join(MARK + name.encode("latin-1") + b"\n" + content for name, content in sections)[1:]


@contextmanager
def in_folder(files: Sequence[Section]) -> Iterator[Path]:
    """A folder with these files in it; names that lead out of it, or that no file can have, are left out."""
    with tempfile.TemporaryDirectory(dir=MEMORY if MEMORY.is_dir() else None) as name:
        folder = Path(name)
        for relative, content in files:
            if FILE_NAME.fullmatch(relative) and not {".", ".."} & set(relative.split("/")):
                path = folder / relative
                if path.is_dir() or path.parent.is_file():
                    continue
                path.parent.mkdir(exist_ok=True)
                path.write_bytes(content)
        yield folder


def mutated_sections(data: bytes, rng: random.Random, mutate: Callable[[bytes], bytes]) -> bytes:
    """One section changed as its kind asks for, or taken out, doubled or renamed."""
    sections = sections_of(data)
    if not sections or rng.random() < 0.1:
        return mutate(data)
    at = rng.randrange(len(sections))
    name, content = sections[at]
    way = rng.random()
    if way < 0.03:
        del sections[at]
    elif way < 0.06:
        sections.append((rng.choice(sections)[0], content))
    elif content.startswith(SIGNATURE):
        sections[at] = name, mutated_png(content, rng, mutate)
    elif content.lstrip()[:1] in (b"{", b"["):
        sections[at] = name, mutated_json(content, rng, mutate)
    else:
        sections[at] = name, mutate(content)
    return joined(sections)
