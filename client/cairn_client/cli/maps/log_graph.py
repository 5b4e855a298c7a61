"""A page of a map's log as a graph: lines from each entry to what it hangs on, as far as that is on the page.

*       1  +  mole.0123456789abcdef.0
*       2  +  mole.0123456789abcdef.1         its author's commit before
│ *     3  +  operator.89abcdef01234567.0     retracts mole.0123456789abcdef.1
x─╯     4  -  mole.0123456789abcdef.1         what is taken out, and by which
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress

from cairn_client.cli.maps.graph_drawing import draw
from cairn_map.commits.cursor import cursor_from_text
from cairn_map.errors import BadInputError
from cairn_map.wire.messages import LogEntry


def graph_of(entries: Sequence[LogEntry]) -> list[list[int]]:
    """For each entry its seq and those that it hangs on.

    A commit hangs on its parent; what is taken out on the commit that was, and on the one that retracts it.
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
    """What lines cannot say."""
    text = ""
    if entry.kind == "+" and entry.retracts:
        text += f"  retracts {entry.retracts[0]}" + (
            f" and {len(entry.retracts) - 1} more" if len(entry.retracts) > 1 else ""
        )
    if entry.kind == "+" and entry.seen:
        with suppress(BadInputError):  # the author's own words, which nobody checked
            text += f"  saw {cursor_from_text(entry.seen).seq}"
    return text
