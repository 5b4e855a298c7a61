"""Compare two maps: a copy and its server, two servers, two folders.

    $ cairn diff lab                                     # a copy against the server that it is from
    equal: 34 cells, 412873 voxels
    $ cairn diff lab http://127.0.0.1:8750/maps/other
    A  lab: 34 cells, 412873 voxels, 1.2 MB, 15 commits
    B  http://127.0.0.1:8750/maps/other: 33 cells, 400124 voxels, 1.2 MB, 17 commits
    only in A       1 cell: 0,2,0
    other content   3 cells: 0,0,0 0,1,0 1,1,0
    commits         0 only in A, 2 only in B

A and B are a map's URL, a folder of `cairn clone`, a robot's state folder (commits that wait are part of its map), or a
folder of `cairn map export --cells`. Cells are compared by their fingerprints: none is downloaded.
A token is sent to its own server only: `--token TOKEN` is that of the first URL, `--token http://base:8750=TOKEN` of
another. As with diff, the exit code is 0 if they are equal, and 1 if they are not or if they cannot be compared.
"""

import argparse
import json
from pathlib import Path

from cairn_client.cli.arguments import add_token, parser, say, shown_bytes
from cairn_client.cli.maps.map_sides import Difference, MapSide, difference, side_of
from cairn_client.folders.state_folder import url_of
from cairn_map.evidence.grid import CellKey, cell_of_key

EQUAL, DIFFERENT = 0, 1
SHOWN = 12
"""Cells named in a line; --json names all."""


def main(argv: list[str]) -> int:
    """Compare the two maps."""
    command = parser("cairn diff", __doc__)
    command.add_argument("a", metavar="A", help="URL or folder")
    command.add_argument("b", metavar="B", nargs="?", help="URL or folder (the server that A is a copy of)")
    command.add_argument("--json", action="store_true", help="print JSON")
    add_token(command)
    args = command.parse_args(argv)
    if args.b is None and "://" in args.a:
        command.error("of a URL, say what it is to be compared with")
    a, b = _sides(args)
    found = difference(a, b)
    if args.json:
        say(json.dumps(_as_json(a, b, found)))
    elif found.is_equal:
        say(f"equal: {len(a.cells)} cells, {a.voxels} voxels{_commits_line(found)}")
    else:
        _show(a, b, found)
    return EQUAL if found.is_equal else DIFFERENT


def _sides(args: argparse.Namespace) -> tuple[MapSide, MapSide]:
    other = args.b or url_of(Path(args.a))
    first = next((place for place in (args.a, other) if "://" in place), other)
    tokens = args.token.bound_to(first)
    return side_of(args.a, tokens=tokens), side_of(other, tokens=tokens)


def _show(a: MapSide, b: MapSide, found: Difference) -> None:
    for letter, side in (("A", a), ("B", b)):
        commits = "" if side.commits is None else f", {len(side.commits)} commits"
        size = shown_bytes(side.size_bytes)
        say(f"{letter}  {side.name}: {len(side.cells)} cells, {side.voxels} voxels, {size}{commits}")
    for what, keys in (("only in A", found.only_a), ("only in B", found.only_b), ("other content", found.other)):
        if keys:
            say(f"{what:<15} {len(keys)} cell{'s' if len(keys) > 1 else ''}: {_named(keys)}")
    if found.commits_only_a is not None:
        say(f"{'commits':<15} {found.commits_only_a} only in A, {found.commits_only_b} only in B")


def _commits_line(found: Difference) -> str:
    """Note on commits that only one side has, though all cells are equal: one and its retract, for example."""
    if not found.commits_only_a and not found.commits_only_b:
        return ""
    return f"; of {found.commits_only_a} commits only A, of {found.commits_only_b} only B knows"


def _named(keys: list[CellKey]) -> str:
    more = f" and {len(keys) - SHOWN} more" if len(keys) > SHOWN else ""
    return " ".join(str(cell_of_key(key)) for key in keys[:SHOWN]) + more


def _as_json(a: MapSide, b: MapSide, found: Difference) -> dict[str, object]:
    def cells(keys: list[CellKey]) -> list[list[int]]:
        return [list(cell_of_key(key)) for key in keys]

    def side(one: MapSide) -> dict[str, object]:
        commits = None if one.commits is None else len(one.commits)
        sizes = {"voxels": one.voxels, "size_bytes": one.size_bytes}
        return {"name": one.name, "cells": len(one.cells), **sizes, "commits": commits}

    return {
        "equal": found.is_equal,
        "a": side(a),
        "b": side(b),
        "only_a": cells(found.only_a),
        "only_b": cells(found.only_b),
        "other": cells(found.other),
        "commits_only_a": found.commits_only_a,
        "commits_only_b": found.commits_only_b,
    }
