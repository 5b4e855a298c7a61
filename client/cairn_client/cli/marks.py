"""Marks of a map: places with a name that all robots and people see, listed, added, changed and removed.

    $ cairn map mark http://127.0.0.1:8750/maps/lab --add "north door" --at 1.5,-2,1 --kind door --note "locked"
    operator.5e0c7a1f92b3d486.0:0  door  north door  at 1.50, -2.00, 1.00 m
    $ cairn map marks http://127.0.0.1:8750/maps/lab --box 0,-5,0,5,5,3
    operator.5e0c7a1f92b3d486.0:0  door  north door  at 1.50, -2.00, 1.00 m  by admin, 2026-11-27 14:05:00 UTC
      locked
    $ cairn map mark http://127.0.0.1:8750/maps/lab --edit operator.5e0c7a1f92b3d486.0:0 --attach lock.jpg
    $ cairn map mark http://127.0.0.1:8750/maps/lab --remove operator.5e0c7a1f92b3d486.1:0

The text before a mark is its key: the commit that brought it, and its number there. A change is a new commit, and so a
new key; two people who change one mark on two servers leave two marks, which are listed as changed twice until one of
them is removed. It takes an operator's token to mark; a robot marks by `Robot.mark`. --after CURSOR lists what came and
went since a list, whose last line (or `cursor`, in --json) names its state.

Many detections of one thing are read as one with --group METRES: marks of one kind whose middles are so close to the
first of them, by time and then key, whatever order they came in. Nothing is changed by it.

A mark has at most one attachment of up to 16 MB, such as a picture; --save-attachments FOLDER writes those of the marks
that are listed into files, each named by its SHA-256 and by what its first bytes are. The mark is there first: of some
the attachment comes to the server later.
"""

import argparse
import json
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

from cairn_client.cli.arguments import Subparsers, add_map_parser, api_of, say, shown_bytes
from cairn_client.cli.robot_arguments import box, place
from cairn_client.http.api import MapApi
from cairn_client.http.attachment_copy import attachment_bytes, fetched_attachment, send_attachment
from cairn_client.http.mark_pages import mark_pages
from cairn_client.sync.responses import one_line, shown_text
from cairn_map.commits.attachment import Attachment, attachment_of, media_type_of
from cairn_map.commits.mark import Mark, mark_key_from_text
from cairn_map.errors import BadInputError, NotFoundError
from cairn_map.queries.mark_groups import MarkGroup, group_marks
from cairn_map.wire.mark_messages import MarkEntry, MarkPage, MarkRequest, MarkText, edited_twice

KIND = "mark"
"""Kind of a mark of which none is stated."""


def add_list_parser(commands: Subparsers) -> None:
    """Add the subcommand `marks`."""
    marks = add_map_parser(commands, "marks", _list, text="list the marks of a map")
    marks.description = __doc__
    marks.add_argument("--box", type=box, metavar="X0,Y0,Z0,X1,Y1,Z1", help="only in this box, metres")
    marks.add_argument("--kind", help="only of this kind")
    marks.add_argument("--after", metavar="CURSOR", help="only what came and went since the list that named it")
    marks.add_argument(
        "--group", type=float, metavar="METRES", help="read marks of one kind within METRES of the first as one thing"
    )
    marks.add_argument("--save-attachments", type=Path, metavar="FOLDER", help="save the attachments into this folder")
    marks.add_argument("--json", action="store_true", help="print JSON")


def add_parser(commands: Subparsers) -> None:
    """Add the subcommand `mark`."""
    mark = add_map_parser(commands, "mark", _mark, text="add, change or remove a mark of a map")
    mark.description = __doc__
    act = mark.add_mutually_exclusive_group(required=True)
    act.add_argument("--add", metavar="NAME", help="a new mark of this name; takes --at")
    act.add_argument("--edit", metavar="KEY", help="change what the other options state of this one")
    act.add_argument("--remove", metavar="KEY", help="take this one out")
    mark.add_argument("--name", help="with --edit: its name, one line of up to 64 characters")
    mark.add_argument("--at", type=place, metavar="X,Y,Z", help="its middle, metres, map frame")
    mark.add_argument("--extent", type=place, metavar="X,Y,Z", help="edges of a box around it, metres (a point)")
    mark.add_argument("--kind", help=f"sort of thing, such as door, hot_spot, person ({KIND})")
    mark.add_argument("--note", help="text of up to 1024 characters")
    mark.add_argument("--attach", type=Path, metavar="FILE", help="attach this file, such as a picture, to 16 MB")
    mark.add_argument("--detach", action="store_true", help="with --edit: without its attachment")
    mark.add_argument("--json", action="store_true", help="print JSON")


def _list(args: argparse.Namespace) -> int:
    api, name = api_of(args.map, args.token)
    with api:
        pages = list(mark_pages(api, name, box_m=args.box, after=args.after))
        entries = [each for page in pages for each in page.marks if args.kind in (None, each.mark.kind)]
        saved = _save_attachments(api, name, entries, args.save_attachments) if args.save_attachments else []
    removed = [commit for page in pages for commit in page.removed]
    if args.group is not None:
        return _show_groups(group_marks(entries, radius_m=args.group), is_json=args.json)
    if args.json:
        found = MarkPage(
            cursor=pages[-1].cursor, from_start=pages[0].from_start, more=False, marks=entries, removed=removed
        )
        say(found.model_dump_json())
        return 0
    for line in lines_of(entries):
        say(line)
    for commit in removed:
        say(f"{commit}  was changed or removed")
    for line in saved:
        say(line)
    if not entries and not removed:
        say("(no marks; `cairn map mark MAP --add NAME --at X,Y,Z` makes one)" if args.after is None else "(no news)")
    say(f"state {pages[-1].cursor}")
    return 0


def lines_of(entries: list[MarkEntry]) -> Iterator[str]:
    """Marks as lines for people, with their notes below them."""
    twice = edited_twice(entries)
    for entry in entries:
        made = _utc(entry.mark.time_ms)
        line = f"{_line(entry.key, entry.mark)}  by {one_line(entry.author)}, {made}"
        yield line + ("  (changed twice: remove one)" if entry.key in twice else "")
        for text in entry.mark.note.splitlines():
            yield f"  {shown_text(text)}"
        if entry.mark.attachment is not None:
            yield f"  attachment {entry.mark.attachment.sha256}, {shown_bytes(entry.mark.attachment.size_bytes)}"


def _show_groups(groups: list[MarkGroup], *, is_json: bool) -> int:
    """Print groups of marks, by the time of the first mark of each: a line each, or a list in JSON."""
    if is_json:
        say(json.dumps([_group_fields(group) for group in groups]))
        return 0
    for group in groups:
        x, y, z = group.place_m
        first, last = (_utc(time_ms) for time_ms in group.time_ms)
        line = f"{len(group.entries)} marks  {group.kind}  {one_line(group.name)}  at {x:.2f}, {y:.2f}, {z:.2f} m"
        say(f"{line}  by {', '.join(map(one_line, group.authors))}, {first} to {last}")
    if not groups:
        say("(no marks)")
    return 0


def _group_fields(group: MarkGroup) -> dict[str, object]:
    return {
        "kind": group.kind,
        "name": group.name,
        "place_m": group.place_m,
        "authors": group.authors,
        "time_ms": group.time_ms,
        "keys": [entry.key for entry in group.entries],
    }


def _utc(time_ms: int) -> str:
    return f"{datetime.fromtimestamp(time_ms / 1000, UTC):%Y-%m-%d %H:%M:%S} UTC"


def _save_attachments(api: MapApi, name: str, entries: list[MarkEntry], folder: Path) -> list[str]:
    """Write the attachments of marks into files; a line for each.

    Raises:
        BadInputError: kind `bad_output`: a file cannot be written.
    """
    lines = []
    for attachment in dict.fromkeys(each.mark.attachment for each in entries):
        if attachment is None:
            continue
        data = fetched_attachment(api, name, attachment.sha256)
        if data is None:
            lines.append(f"attachment {attachment.sha256} did not come to the server yet")
            continue
        path = folder / f"{attachment.sha256}{media_type_of(data)[1]}"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
        except OSError as exc:
            raise BadInputError("bad_output", f"cannot write {path}: {exc.strerror}") from exc
        lines.append(f"saved {path}")
    return lines


def _mark(args: argparse.Namespace) -> int:
    api, name = api_of(args.map, args.token)
    with api:
        data = attachment_bytes(args.attach)
        request = _request(args, api, name, attachment_of(data) if data else None)
        receipt = api.put_mark(name, request)
        if data and request.mark is not None and request.mark.attachment is not None:
            send_attachment(api, name, request.mark.attachment, data)
    if args.json:
        say(receipt.model_dump_json())
    elif receipt.key is None or request.mark is None:
        say(f"{request.of} is removed")
    else:
        x, y, z = request.mark.place_m
        say(f"{receipt.key}  {request.mark.kind}  {one_line(request.mark.name)}  at {x:.2f}, {y:.2f}, {z:.2f} m")
    return 0


def _request(args: argparse.Namespace, api: MapApi, name: str, attached: Attachment | None) -> MarkRequest:
    """Request that a command line states.

    Raises:
        BadInputError: kind `bad_option`: a new mark without a place, or options that say nothing of what is asked.
        NotFoundError: kind `no_mark`.
    """
    stated = {"name": args.name, "place_m": args.at, "extent_m": args.extent, "kind": args.kind, "note": args.note}
    fields = {key: value for key, value in (stated | {"attachment": attached}).items() if value is not None}
    if args.detach:
        if args.edit is None or attached is not None:
            raise BadInputError("bad_option", "--detach goes with --edit, and without --attach")
        fields["attachment"] = None
    if args.remove is not None:
        if fields:
            other = next(iter(fields)).split("_")[0].replace("attachment", "attach")
            raise BadInputError("bad_option", f"--remove takes a key alone, not --{other} too")
        return MarkRequest(of=str(mark_key_from_text(args.remove)))
    if args.add is not None:
        if args.at is None or args.name is not None:
            raise BadInputError("bad_option", "--add NAME takes --at X,Y,Z, and the name only once")
        return MarkRequest(mark=MarkText.model_validate({"kind": KIND, "name": args.add} | fields))
    if not fields:
        raise BadInputError("bad_option", "--edit takes what is to change, such as --name, --at, --note or --attach")
    key = mark_key_from_text(args.edit)
    entries = [entry for page in mark_pages(api, name) for entry in page.marks if entry.mark_key == key]
    if not entries:
        raise NotFoundError("no_mark", f"map {name} has no mark {key}; `cairn map marks` lists them")
    mark = entries[0].mark
    x, y, z = mark.extent_mm
    known = {
        "kind": mark.kind,
        "name": mark.name,
        "place_m": mark.place_m,
        "extent_m": (x / 1000, y / 1000, z / 1000),
        "note": mark.note,
        "attachment": mark.attachment,
    }
    return MarkRequest(of=str(key), mark=MarkText.model_validate(known | fields))


def _line(key: str, mark: Mark) -> str:
    x, y, z = mark.place_m
    return f"{key}  {mark.kind}  {one_line(mark.name)}  at {x:.2f}, {y:.2f}, {z:.2f} m"
