"""The log as a graph, and graphs as text: every line leads from a node to one that it hangs on."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cairn_client.cli.maps.map_log import LANES_MAX, draw, graph_of, log_graph
from cairn_map.wire.messages import LogEntry

Graph = list[list[int]]
UP, DOWN, LEFT, RIGHT = (-1, 0), (1, 0), (0, -1), (0, 1)
WAYS = {
    "│": {UP, DOWN},
    "─": {LEFT, RIGHT},
    "┼": {UP, DOWN, LEFT, RIGHT},
    "╮": {LEFT, DOWN},
    "╭": {RIGHT, DOWN},
    "╯": {LEFT, UP},
    "╰": {RIGHT, UP},
    "┤": {LEFT, UP, DOWN},
    "├": {RIGHT, UP, DOWN},
    "┬": {LEFT, RIGHT, DOWN},
    "┴": {LEFT, RIGHT, UP},
}


@pytest.mark.parametrize(
    ("graph", "picture"),
    [
        ([], []),
        ([[1]], ["*"]),
        ([[1], [2, 1], [3, 2]], ["*", "*", "*"]),
        ([[1], [2, 1], [3, 1]], ["*", "├─*", "*"]),
        ([[1], [2], [3, 1], [4, 2, 3]], ["  *", "* │", "│ *", "*─╯"]),
        ([[1], [2], [3], [4, 1, 2, 3]], ["*", "│ *", "│ │ *", "*─┴─╯"]),
        ([[1], [2], [3, 1], [4, 2]], ["  *", "* │", "│ *", "*"]),
        ([[1, 99], [2, 2]], ["*", "*"]),
    ],
)
def test_small_graphs_look_like_this(graph: Graph, picture: list[str]) -> None:
    assert draw(graph) == picture


@st.composite
def graphs(draw_value: st.DrawFn) -> Graph:
    """Any graph in which nodes hang on at most three earlier ones."""
    size = draw_value(st.integers(0, 14))
    return [
        [n, *sorted(draw_value(st.sets(st.integers(1, n - 1), max_size=min(3, n - 1))) if n > 1 else [])]
        for n in range(1, size + 1)
    ]


@given(graphs())
def test_rows_are_one_for_each_node_and_lines_have_no_loose_ends(graph: Graph) -> None:
    rows = draw(graph)
    assert [row.count("*") for row in rows] == [1] * len(graph)
    width = max(map(len, rows), default=0)
    field = [row.ljust(width) for row in rows]
    for y, row in enumerate(field):
        for x, letter in enumerate(row):
            for dy, dx in WAYS.get(letter, set()):
                beside = field[y + dy][x + dx] if 0 <= y + dy < len(field) and 0 <= x + dx < width else " "
                assert beside == "*" or (-dy, -dx) in WAYS.get(beside, set()), "\n".join(rows)


@given(graphs())
def test_every_edge_can_be_followed_upwards(graph: Graph) -> None:
    rows = draw(graph)
    width = max(map(len, rows), default=0)
    field = [row.ljust(width) for row in rows]
    for y, (_, *edges) in enumerate(graph):
        reached = {graph[found][0] for found in upwards(field, y)}
        assert set(edges) <= reached, "\n".join(rows)


def upwards(field: list[str], y: int) -> set[int]:
    """Rows of the nodes that lines lead to from a row's node without going down."""
    start = (y, field[y].index("*"))
    seen, todo, found = {start}, [start], set()
    while todo:
        at = todo.pop()
        letter = field[at[0]][at[1]]
        if letter == "*" and at != start:
            found.add(at[0])
            continue
        for dy, dx in (UP, LEFT, RIGHT) if letter == "*" else WAYS[letter] - {DOWN}:
            there = (at[0] + dy, at[1] + dx)
            inside = there[0] >= 0 and 0 <= there[1] < len(field[0])
            if inside and there not in seen and field[there[0]][there[1]] != " ":
                beside = field[there[0]][there[1]]
                if beside == "*" or (-dy, -dx) in WAYS[beside]:
                    seen.add(there)
                    todo.append(there)
    return found


def test_a_graph_of_very_many_lines_stays_narrow() -> None:
    roots = [[n] for n in range(1, 101)]
    rows = draw([*roots, [101, *range(1, 101)]])
    assert max(map(len, rows)) <= 2 * LANES_MAX + 1
    assert rows[-1].count("*") == 1


def entry(seq: int, kind: str, name: str, parent: str | None = None, retracts: tuple[str, ...] = ()) -> LogEntry:
    sha = {name: f"{number:064x}" for number, name in enumerate("abcdefghij")}
    return LogEntry.model_validate(
        {
            "seq": seq,
            "kind": kind,
            "id": f"mole.0123456789abcdef.{'abcdefghij'.index(name)}",
            "sha": sha[name],
            "size_bytes": 1,
            "cells": 1,
            "captured_s": None,
            "retracts": [f"mole.0123456789abcdef.{'abcdefghij'.index(target)}" for target in retracts],
            "parent": sha[parent] if parent else None,
            "seen": f"{'0' * 32}.7.{'0' * 32}" if name == "b" else "not a cursor" if name == "c" else None,
        }
    )


def test_commits_hang_on_their_parents_and_what_is_taken_out_on_what_it_was_and_who_did_it() -> None:
    entries = [
        entry(4, "+", "b", parent="a"),  # a is on the page before
        entry(5, "+", "c", parent="b"),
        entry(6, "+", "d", retracts=("b", "e")),
        entry(7, "-", "b"),
        entry(8, "+", "f", retracts=("b",)),  # too late: it takes out nothing
        entry(9, "+", "e", parent="c"),  # which was retracted before it came
        entry(10, "-", "e"),
    ]
    assert graph_of(entries) == [[4], [5, 4], [6], [7, 4, 6], [8], [9, 5], [10, 9, 6]]
    lines = list(log_graph(entries))
    assert len(lines) == len(entries)
    assert lines[0].endswith("4  +  mole.0123456789abcdef.1  saw 7")
    assert lines[1].endswith("5  +  mole.0123456789abcdef.2")
    assert lines[2].endswith("6  +  mole.0123456789abcdef.3  retracts mole.0123456789abcdef.1 and 1 more")
    assert "x" in lines[3].split("7")[0] and lines[3].endswith("7  -  mole.0123456789abcdef.1")


def test_an_empty_page_is_no_line() -> None:
    assert list(log_graph([])) == []
