"""Check this installation, a state folder, the way to a server, and a live robot.

    $ cairn doctor http://127.0.0.1:8750/maps/lab
    ok    python        3.11.9 on x86_64
    ok    cairn         0.1.0
    ok    extra robot   all there
    warn  kernels       31 of 48 compiled
                        -> `cairn compile` compiles them now, half a minute; else the first scans wait for it
    ok    disk          212.40 GB free at /data
    ok    server        answers in 1.2 ms (median of 5; 1.9 ms at worst)
    ok    protocol      version 1, here and there
    ok    clock         the server's agrees with ours, to within 1.0 s
    ok    ready         takes pushes and folds them
    ok    token         no token: map lab may be read; 34 cells, 15 commits
    ok    store         5f0c2d1be07a3c44, shared; 2 of its servers answered here
    ok    servers       3: 2 answer, 1 fold; version 0.1.0
    ok    folding       no commit waits; the last fold was 3 s ago
    ok    clocks        the servers' differ from the database's by at most 0.01 s
    ok    speed         48.1 MB/s down: a cell of 212.0 kB in 4 ms

Without an argument the installation alone is checked; with a server's or a map's URL, the way there as well, and the
servers behind that address: whether they share one store, how many answer and fold, their versions and clocks. Further
URLs, such as the servers' own behind a proxy, are compared with the first: all have to be of one store. With a
state folder (of a robot, or of `cairn clone`), its content, and of a copy the way to its server.

With the door of a live robot (ws://HOST:PORT or another, see `cairn robot live --help`), its topics, poses and clock
for some seconds, in the words of that command's status line; --topics is its topics file. Nothing is mapped.

A line that is not `ok` has the next step below it. The exit code is 0 if nothing failed (there may be warnings), else
1.
"""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from cairn_client.cli.arguments import add_token, parser, say
from cairn_client.cli.doctor.checks import (
    Check,
    CheckResult,
    disk_check,
    folder_checks,
    grid_check,
    installation_checks,
    server_checks,
)
from cairn_client.cli.doctor.site import site_checks
from cairn_client.folders.state_folder import opened_replica
from cairn_client.http.api import MapApi
from cairn_client.http.map_url import split_map_url
from cairn_client.http.origin_tokens import OriginTokens
from cairn_client.live.live_source import SCHEMES, URL_HELP
from cairn_client.robot.membership import own_token
from cairn_map.errors import BadInputError, CairnError
from cairn_map.evidence.grid import Geometry

SOUND, ILL = 0, 1


def main(argv: list[str]) -> int:
    """Run the checks."""
    command = parser("cairn doctor", __doc__)
    command.add_argument(
        "target", nargs="?", metavar="URL|DIR", help="a server, a map, a live robot's door, or a state folder"
    )
    command.add_argument("others", nargs="*", metavar="URL", help="more addresses of the same servers")
    command.add_argument("--topics", type=Path, metavar="YAML", help="of a live robot: meaning of the topics")
    command.add_argument("--ca", type=Path, metavar="FILE", help="of a live robot: issuer of the certificate of wss://")
    command.add_argument("--json", action="store_true", help="print JSON")
    add_token(command)
    args = command.parse_args(argv)
    checks: list[Check] = []
    target: str = args.target or ""
    is_live = target.startswith(SCHEMES)
    if not is_live and (args.topics or args.ca):
        raise BadInputError("bad_option", f"--topics and --ca are of a live robot; {URL_HELP}")
    if is_live and args.others:
        raise BadInputError("bad_option", f"a live robot has one door; check {args.others[0]} by a command of its own")
    found = _live(target, args.topics, args.ca) if is_live else _checks(args.target, args.others, args.token)
    for check in found:
        checks.append(check)
        if not args.json:
            _show(check)
    if args.json:
        say(json.dumps([check.as_json() for check in checks]))
    return ILL if any(check.verdict is CheckResult.FAIL for check in checks) else SOUND


def _checks(target: str | None, others: list[str], tokens: OriginTokens) -> Iterator[Check]:
    yield from installation_checks()
    if target is None or "://" in target:
        yield disk_check(Path())
    if target is not None and "://" in target:
        bound = tokens.bound_to(target)
        yield from _of_url(target, bound.of(target), [(other, bound.of(other)) for other in others])
    elif target is not None:
        yield from folder_checks(Path(target))
        link = _link_of(Path(target))
        if link is not None:
            token = link.token or tokens.of(link.url)
            yield from _of_url(link.url, token)
            server, name = split_map_url(link.url)
            with MapApi(server, token=token) as api:
                yield grid_check(api, name, link.geometry)


def _live(url: str, topics: Path | None, ca: Path | None) -> Iterator[Check]:
    yield from installation_checks()
    try:  # the other checks do without these libraries
        from cairn_client.cli.doctor.live_checks import live_checks
    except ModuleNotFoundError as exc:
        advice = 'pip install "cairn-robotics[robot]"'
        yield Check("live", CheckResult.FAIL, f"live robots need {exc.name}", advice)
        return
    yield from live_checks(url, topics, ca_file=ca)


def _of_url(url: str, token: str | None, others: Sequence[tuple[str, str | None]] = ()) -> Iterator[Check]:
    """Checks of a server or map, and of more addresses of the same servers, each with its token."""
    server, name = _server_of(url)
    for check in server_checks(server, name, token=token):
        yield check
        if check.what == "token" and check.verdict is CheckResult.OK:
            yield from site_checks([(server, token), *((_server_of(url)[0], own) for url, own in others)])


def _server_of(url: str) -> tuple[str, str | None]:
    return split_map_url(url) if "/maps/" in url else (url, None)


@dataclass(frozen=True, slots=True)
class _Link:
    url: str
    token: str | None
    geometry: Geometry


def _link_of(folder: Path) -> _Link | None:
    """The map that a folder is of; None where it cannot be opened, or knows none."""
    try:
        with opened_replica(folder) as replica:
            url = replica.state.url
            return _Link(url, own_token(replica.state, url), replica.geometry) if url else None
    except CairnError:  # said already
        return None


def _show(check: Check) -> None:
    say(f"{check.verdict.value:<4}  {check.what:<12}  {check.found}")
    if check.advice:
        say(f"{'':<20}-> {check.advice}")
