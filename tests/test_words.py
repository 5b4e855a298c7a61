"""STYLE.md's English, held by reading the sources: docstrings name what they document, and they, comments and messages
use the field's own words.

$ python -m tests.test_words [PATH ...]      # every finding below these paths, a line each
"""

import ast
import re
import sys
import tokenize
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

from tests.fixtures.sources import ROOT, docstrings, modules, tree_of

OPENINGS = re.compile(r"(?:What|How|Whether|Which|Whose|Who|Whoever|Where|When|Why|Of|It|Nobody|A whole one)\b")
"""A docstring that begins so asks a question, or cannot be read without the line above it."""
BANNED = re.compile(r"\b(?:anew|beside|dear|nobody|whoever|told|as before|by then|not known of)\b", re.IGNORECASE)
"""Words of a private dialect: say again, next to, expensive, no client, any caller, reported."""
NAMES = {
    *("across", "applying", "asked_view", "asked_voxel", "bands", "begun_frames", "beside", "carried", "carrying"),
    *("clear", "fold_around", "fold_here", "joining", "judged_grid", "last_seen", "looked", "made_once", "one_way"),
    *("opening", "own_end", "placed", "ready_views", "resting", "returns", "shown", "stable", "told", "views_ahead"),
}
"""Participles, adverbs and prepositions are no names of modules."""

EXCEPTIONS: frozenset[str] = frozenset()
"""Findings that may stay, as `path: text`, each because the field says it so."""
EXCEPTIONS_MAX = 20


class Finding(NamedTuple):
    """One place that STYLE.md would have otherwise."""

    path: str
    line: int
    text: str

    def __str__(self) -> str:
        return f"{self.path}:{self.line}: {self.text}"


@cache
def findings(path: Path) -> tuple[Finding, ...]:
    """All that one module has."""
    return tuple(_found(path))


def _found(path: Path) -> Iterator[Finding]:
    where = path.relative_to(ROOT).as_posix()
    if path.stem in NAMES:
        yield Finding(where, 1, f"module name {path.stem}")
    with path.open("rb") as file:
        tokens = list(tokenize.tokenize(file.readline))
    prose = [(token.start[0], token.string) for token in tokens if token.type == tokenize.COMMENT]
    tree = tree_of(path)
    documents = list(docstrings(tree))
    strings = {node for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)}
    prose += [(node.lineno, str(node.value)) for node in strings - set(documents)]
    for docstring in documents:
        line, text = docstring.lineno, str(docstring.value).strip()
        prose.append((line, text))
        if OPENINGS.match(text):
            yield Finding(where, line, text.partition("\n")[0])
    for line, text in prose:
        for found in BANNED.finditer(text):
            around = text[max(0, found.start() - 30) : found.end() + 30].replace("\n", " ")
            yield Finding(where, line + text.count("\n", 0, found.start()), f"'{found[0]}' in: {around}")


def test_docstrings_comments_messages_and_names_are_plain_english() -> None:
    found = [one for _, path in modules() for one in findings(path)]
    assert [str(one) for one in found if f"{one.path}: {one.text}" not in EXCEPTIONS] == []


def test_every_exception_is_still_there_and_they_are_few() -> None:
    found = {f"{one.path}: {one.text}" for _, path in modules() for one in findings(path)}
    assert found >= EXCEPTIONS
    assert len(EXCEPTIONS) <= EXCEPTIONS_MAX


if __name__ == "__main__":
    wanted = [Path(name).resolve() for name in sys.argv[1:]] or [ROOT]
    shown = [one for _, path in modules() if any(path.is_relative_to(to) for to in wanted) for one in findings(path)]
    sys.stdout.write("".join(f"{one}\n" for one in shown) + f"{len(shown)} findings\n")
