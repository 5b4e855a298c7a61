"""Follow a map live: commits that are folded, robots that report, the head that moves.

    $ cairn watch http://127.0.0.1:8750/maps/lab
    15:04:05  lab is at 15, robots: mole wren
    15:04:09  mole  high-end, at (1.20, 0.40, 0.00) m, 0 commits wait
    15:04:10  5 cells changed
    15:04:10  folded  mole.1f2e3d4c5b6a7988.15  5 cells, 20.1 kB
    15:04:10  head  16
    $ cairn watch http://127.0.0.1:8750/maps/lab --json | jq -c 'select(.type == "head")'

It goes on until Ctrl-C, and connects again when the link breaks, from where it was; events missed meanwhile are printed
then. --json prints each event as a line, as PROTOCOL.md 4.6 has it; `lost` is our own, for a broken link. --events N
ends after N of them.
"""

import json
import sys
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from typing import TextIO

from cairn_client.cli.arguments import add_token, api_of, parser, shown_bytes
from cairn_client.cli.maps.branch_table import shown_metres
from cairn_client.http.live_listener import Lost, listen
from cairn_client.sync.responses import one_line, shown_text
from cairn_map.commits.cursor import cursor_from_text
from cairn_map.wire.live_events import (
    CellsEvent,
    HeadMoved,
    Hello,
    LiveEvent,
    LogGrew,
    MarksEvent,
    RobotHeard,
    RobotSign,
)
from cairn_map.wire.mark_messages import MarkEntry


def main(argv: list[str]) -> int:
    """Print events until interrupted."""
    command = parser("cairn watch", __doc__)
    command.add_argument("map", help="http://HOST:PORT/maps/NAME")
    command.add_argument("--json", action="store_true", help="print each event as a line of JSON")
    command.add_argument("--events", type=int, metavar="N", help="end after so many events")
    add_token(command)
    args = command.parse_args(argv)
    api, name = api_of(args.map, args.token)
    left = args.events
    with api:
        for event in listen(api, name):
            if isinstance(event, Lost) and not args.json:
                _write(sys.stderr, f"link lost: {event.reason}; trying again in {event.retry_in_s:.1f} s")
            elif args.json:
                _write(sys.stdout, json.dumps(_as_json(event)))
            else:
                for line in lines_of(event):
                    _write(sys.stdout, f"{datetime.now(UTC):%H:%M:%S}  {line}")
            if left is not None and not isinstance(event, Lost):
                left -= 1
                if left <= 0:
                    return 0
    return 0


def lines_of(event: LiveEvent | Lost) -> Iterator[str]:
    """An event as lines for people; none for a heartbeat."""
    match event:
        case Hello():
            robots = " ".join(sign.branch for sign in event.robots if not sign.gone) or "none"
            yield f"{event.map} is at {cursor_from_text(event.cursor).seq}, robots: {robots}"
        case LogGrew():
            if event.left_out:
                yield f"({event.left_out} more commits before these)"
            for entry in event.entries:
                word = "folded" if entry.kind == "+" else "taken out"
                yield f"{word}  {entry.id}  {entry.cells} cells, {shown_bytes(entry.size_bytes)}"
        case CellsEvent():
            yield f"{'many' if event.cells == 'many' else len(event.cells)} cells changed"
        case MarksEvent(marks="many"):
            yield "many marks changed; `cairn map marks` lists them"
        case MarksEvent(marks=list(marks)):
            yield from map(_mark_line, marks)
            for commit in event.removed:
                yield f"mark  {commit}  was changed or removed"
        case HeadMoved():
            yield f"head  {cursor_from_text(event.cursor).seq}"
        case RobotHeard():
            yield _robot_line(event.robot)
        case _:
            return


def _mark_line(entry: MarkEntry) -> str:
    x, y, z = entry.mark.place_m
    place = f"({shown_metres(x)}, {shown_metres(y)}, {shown_metres(z)}) m"
    return f"mark  {entry.key}  {entry.mark.kind}  {one_line(entry.mark.name)}  at {place}  by {one_line(entry.author)}"


def _robot_line(sign: RobotSign) -> str:
    if sign.gone:
        return f"{sign.branch}  left"
    line = f"{sign.branch}  {sign.mode}"
    status = sign.status
    if status is None:
        return line
    if status.pose is not None:
        x, y, z = status.pose.t_map_rig
        line += f", at ({shown_metres(x)}, {shown_metres(y)}, {shown_metres(z)}) m"
    line += f", {status.waiting} commits wait"
    return line + (f", {one_line(status.note)}" if status.note else "")


def _as_json(event: LiveEvent | Lost) -> dict[str, object]:
    if isinstance(event, Lost):
        return {"type": "lost", "time_s": time.time(), "reason": event.reason, "retry_in_s": event.retry_in_s}
    return event.model_dump(mode="json")


def _write(stream: TextIO, line: str) -> None:
    """Write a line and flush it, so that a program that reads a pipe gets it at once."""
    stream.write(shown_text(line) + "\n")
    stream.flush()
