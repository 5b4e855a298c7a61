"""A graph of commits as text: one row each, oldest first, lines in lanes beside them.

    draw([[1], [2], [3, 1], [4, 2, 3]])         a node, then the earlier ones that it hangs on

    *        1
    │ *      2
    * │      3
    ╰─*      4

Rows are made from the newest to the oldest, as `git log --graph` does: a lane leads up to the node that it waits for.
"""

from collections.abc import Mapping, Sequence

LANES_MAX = 24
"""Lines that would need more are left out; the caller says them in words."""
CROSSED = {" ": "─", "│": "┼", "╮": "┬", "╯": "┴", "┤": "┼", "╭": "┬", "╰": "┴", "├": "┼"}
"""What becomes of a place when a line goes through it from left to right."""


def draw(graph: Sequence[Sequence[int]], marks: Mapping[int, str] | None = None) -> list[str]:
    """One row of lines for each node, in the order given.

    Args:
        graph: for each node its number and those of earlier ones that it hangs on; unknown ones are left out.
        marks: what stands for a node, if not `*`.
    """
    known = {node for node, *_ in graph}
    lanes: list[int | None] = []
    rows: list[str] = []
    for node, *edges in reversed(graph):
        wanted = list(dict.fromkeys(edge for edge in edges if edge in known and edge != node))
        rows.append(_row(lanes, node, wanted, (marks or {}).get(node, "*")))
        known.discard(node)
    return rows[::-1]


def _row(lanes: list[int | None], node: int, edges: list[int], mark: str) -> str:
    """The row of one node; `lanes` becomes what it is above the row."""
    before = list(lanes)
    mine = [lane for lane, waits in enumerate(lanes) if waits == node]
    here = mine[0] if mine else _free(lanes)
    for lane in mine:
        lanes[lane] = None
    lanes[here] = -1  # taken, while the others look for a place
    turns: dict[int, tuple[bool, bool]] = dict.fromkeys(mine[1:], (True, False))  # from below, to above
    own: int | None = None
    for edge in edges:
        if edge in lanes:
            lane = lanes.index(edge)
            turns[lane] = (True, True)
        elif own is None:
            own = edge
        elif lanes.count(None) or len(lanes) < LANES_MAX:
            lane = _free(lanes)
            lanes[lane] = edge
            turns[lane] = (turns.get(lane, (False, False))[0], True)
    lanes[here] = own
    row = [" "] * (2 * max(len(before), len(lanes)) - 1)
    for lane, waits in enumerate(before):
        if waits is not None and lane not in mine:
            row[2 * lane] = "│"
    for lane, (below, above) in turns.items():
        corner = "┤├" if below and above else "╮╭" if below else "╯╰"
        row[2 * lane] = corner[lane < here]
    for lane in turns:
        low, high = sorted((2 * lane, 2 * here))
        for x in range(low + 1, high):
            row[x] = CROSSED.get(row[x], row[x])
    row[2 * here] = mark
    while lanes and lanes[-1] is None:
        lanes.pop()
    return "".join(row).rstrip()


def _free(lanes: list[int | None]) -> int:
    """The first lane that nothing goes through; a new one if there is none."""
    if None in lanes:
        return lanes.index(None)
    lanes.append(None)
    return len(lanes) - 1
