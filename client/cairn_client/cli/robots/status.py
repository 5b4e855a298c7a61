"""`cairn robot status`: how the robot of a folder is doing, whether or not it is at work.

$ cairn robot status state/
mole on map lab (http://base:8750/maps/lab), high-end, at work
last contact   12 s ago; failing for 8 s: cannot reach http://base:8750/ [no_link]
waiting        2 commits, 81.3 kB; 5 kept, 203.1 kB
map            14 cells, 1.2 MB, at cursor 6f...
disk           5.3 MB
"""

import argparse
import time
from pathlib import Path

from cairn_client.cli.arguments import say, shown_bytes
from cairn_client.cli.maps.branch_table import shown_age
from cairn_client.folders.folder_status import FolderStatus, folder_status


def add_parser(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the subcommand."""
    status = commands.add_parser("status", help="how the robot of a folder is doing", description=__doc__)
    status.add_argument("folder", type=Path, metavar="DIR", help="the robot's folder")
    status.add_argument("--json", action="store_true", help="print JSON: times in UTC seconds, sizes in bytes")
    status.set_defaults(run=_status)


def _status(args: argparse.Namespace) -> int:
    status = folder_status(args.folder)
    if args.json:
        say(status.model_dump_json())
        return 0
    state = "at work" if status.is_open else "not at work"
    server = status.url or "server unknown"
    say(f"{status.robot} on map {status.map} ({server}), {status.mode or 'mode unknown'}, {state}")
    say(f"  last contact   {_contact(status)}")
    waiting = f"{status.waiting} commits, {shown_bytes(status.waiting_bytes)}"
    say(f"  waiting        {waiting}; {status.kept} kept, {shown_bytes(status.kept_bytes)}")
    place = f"at cursor {status.cursor}" if status.cursor else "not all of the server's"
    say(f"  map            {status.cells} cells, {shown_bytes(status.cells_bytes)}, {place}")
    say(f"  disk           {shown_bytes(status.disk_bytes)}")
    return 0


def _contact(status: FolderStatus) -> str:
    now_s = time.time()
    last = "never" if status.last_contact_s is None else f"{shown_age(now_s - status.last_contact_s)} ago"
    if status.failing_since_s is None:
        return last
    return f"{last}; failing for {shown_age(now_s - status.failing_since_s)}: {status.failure} [{status.failure_kind}]"
