"""`cairn map log`: commits folded and taken out, as a list, or as a graph with lines to the entries they depend on.

*       1  +  mole.0123456789abcdef.0
*       2  +  mole.0123456789abcdef.1         its author's last commit
│ *     3  +  operator.89abcdef01234567.0     retracts mole.0123456789abcdef.1
x─╯     4  -  mole.0123456789abcdef.1         taken out, by the retract above

`draw` makes the lines of any graph of commits, one row each, oldest first, in lanes next to them:

    draw([[1], [2], [3, 1], [4, 2, 3]])         a node, then the earlier ones that it depends on

    *        1
    │ *      2
    * │      3
    ╰─*      4

Rows are made from the newest to the oldest, as `git log --graph` does: a lane leads up to the node that it waits for.
"""

import argparse
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime

from cairn_client.cli.arguments import Subparsers, add_map_parser, api_of, say, shown_bytes
from cairn_client.sync.responses import one_line
from cairn_map.commits.cursor import cursor_from_text
from cairn_map.errors import BadInputError
from cairn_map.wire.messages import LogEntry
from cairn_map.wire.utc_times import with_utc

LANES_MAX = 24
"""Lanes of a drawing; lines that would need more are left out, and the caller says them in words."""
CROSSED = {" ": "─", "│": "┼", "╮": "┬", "╯": "┴", "┤": "┼", "╭": "┬", "╰": "┴", "├": "┼"}
"""Character of a place after a line has gone through it from left to right, by the character before."""


def add_parser(commands: Subparsers) -> None:
    """Add the subcommand."""
    text = "commits folded and taken out, oldest first"
    listing = add_map_parser(commands, "log", _log, text=text)
    listing.add_argument("--json", action="store_true", help="print JSON")
    listing.add_argument("--after", type=int, default=0, metavar="SEQ", help="entries after this one (0)")
    listing.add_argument("--limit", type=int, default=100, help="most entries (100)")
    listing.add_argument("--graph", action="store_true", help="lines from each commit to those that it depends on")


def _log(args: argparse.Namespace) -> int:
    api, name = api_of(args.map, args.token)
    with api:
        entries = api.log(name, after=args.after, limit=args.limit)
        # A page ends early where its entries name very many commits.
        while 0 < len(entries) < args.limit:
            more = api.log(name, after=entries[-1].seq, limit=args.limit - len(entries))
            if not more:
                break
            entries += more
    if args.json:
        say(json.dumps([with_utc(entry).model_dump(mode="json") for entry in entries]))
        return 0
    taken_out = {entry.id: entry.seq for entry in entries if entry.kind == "-"}
    listed = (_log_line(entry, taken_out.get(entry.id)) for entry in entries)
    for line in log_graph(entries) if args.graph else listed:
        say(line)
    if not entries:
        say("(nothing yet)")
    if len(entries) == args.limit:
        say(f"(perhaps more: --after {entries[-1].seq})")
    return 0


def _log_line(entry: LogEntry, taken_out: int | None) -> str:
    """One entry: event, time of capture, commit, size, and the entry that took it out again."""
    word = "folded" if entry.kind == "+" else "taken out"
    size = f"{entry.cells} cells, {shown_bytes(entry.size_bytes)}"
    line = f"{entry.seq:>6}  {word:<9}  {_shown_time(entry.captured_s):<19}  {entry.id}  {size}"
    if entry.retracts:
        more = f" and {len(entry.retracts) - 1} more" if len(entry.retracts) > 1 else ""
        line += f"  retracts {entry.retracts[0]}{more}"
    line += f"  (taken out by {taken_out})" if entry.kind == "+" and taken_out else ""
    return line + _note(entry)


def _note(entry: LogEntry) -> str:
    """Note of a commit's author, in the line of the entry that folded it."""
    return f"  {one_line(entry.note)!r}" if entry.kind == "+" and entry.note else ""


def _shown_time(captured_s: tuple[float, float] | None) -> str:
    """Begin of a measurement, UTC."""
    try:
        return datetime.fromtimestamp(captured_s[0], UTC).strftime("%Y-%m-%d %H:%M:%S") if captured_s else "-"
    except (OverflowError, ValueError, OSError):
        return "-"


def draw(graph: Sequence[Sequence[int]], marks: Mapping[int, str] | None = None) -> list[str]:
    """One row of lines for each node, in the order given.

    Args:
        graph: for each node its number and those of earlier ones that it depends on; unknown ones are left out.
        marks: the character of a node, if not `*`.
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
    """The row of one node; `lanes` is changed to the lanes above the row."""
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


def graph_of(entries: Sequence[LogEntry]) -> list[list[int]]:
    """For each entry its seq and those of the entries that it depends on.

    A commit depends on its parent; an entry that takes a commit out on that commit, and on the one that retracts it.
    """
    folded: dict[str, int] = {}
    by_sha: dict[str, int] = {}
    retracted_by: dict[str, int] = {}
    graph: list[list[int]] = []
    for entry in entries:
        if entry.kind == "-":
            found = [folded.get(entry.id), retracted_by.get(entry.id)]
        else:
            found = [by_sha.get(entry.parent)] if entry.parent else []
            folded[entry.id] = by_sha[entry.sha] = entry.seq
            for target in entry.retracts:
                retracted_by.setdefault(target, entry.seq)  # the first one takes effect
        graph.append([entry.seq, *(seq for seq in found if seq is not None)])
    return graph


def log_graph(entries: Sequence[LogEntry]) -> Iterator[str]:
    """Lines of the picture, oldest first."""
    marks = {entry.seq: "x" for entry in entries if entry.kind == "-"}
    rows = draw(graph_of(entries), marks)
    width = max((len(row) for row in rows), default=0)
    for row, entry in zip(rows, entries, strict=True):
        yield f"{row:<{width}}  {entry.seq:>6}  {entry.kind}  {entry.id}{_remarks(entry)}"


def _remarks(entry: LogEntry) -> str:
    """Facts of an entry that lines cannot show."""
    text = ""
    if entry.kind == "+" and entry.retracts:
        text += f"  retracts {entry.retracts[0]}" + (
            f" and {len(entry.retracts) - 1} more" if len(entry.retracts) > 1 else ""
        )
    if entry.kind == "+" and entry.seen:
        with suppress(BadInputError):  # the author's own words, unchecked
            text += f"  saw {cursor_from_text(entry.seen).seq}"
    return text + _note(entry)
