"""Carry signed commits between servers that do not reach each other.

    $ cairn relay http://field:8750/maps/lab ./carried        # at the field server: take its commits along
    map lab: 12 commits to ./carried, 0 from there
    $ cairn relay ./carried http://base:8750/maps/lab         # at the base, days later
    map lab: 12 commits to http://base:8750/maps/lab, 3 from there

Each place gets what it lacks and the other has, and a repetition changes nothing. A place is a map's URL or a folder;
two URLs join two servers, with --every SECONDS until stopped. Servers take commits from a token of role relay (`cairn
token create URL NAME --role relay --map MAP`), and only as they were signed: a relay can change none, and add none in
the name of a robot whose key it does not have; a robot that a relay invents is recognised in `cairn map log --json` by
the relay that brought it (`via`). `cairn serve --upstream` does the same for all maps of a server. The exit code is 1
if something could not be handed over; the log gives the reason.
"""

import argparse
import logging
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from cairn_client.cli.arguments import add_token, parser, say
from cairn_client.http.backoff import Backoff
from cairn_client.http.map_url import split_map_url
from cairn_client.http.origin_tokens import OriginTokens
from cairn_client.relay.carried_attachments import hand_over_attachments
from cairn_client.relay.carried_commits import CarriedCommits
from cairn_client.relay.link import RelayApi, ServerEnd, hold_between
from cairn_client.relay.round import AT_ONCE, REST_S, RelayReport, RelaySide, Undelivered, log_report, relay_round
from cairn_client.sync.uploads import CAME_IN_PART
from cairn_map.errors import BadInputError, CairnError, UnreachableError
from cairn_map.wire.relay_peer import AttachmentEnd

log = logging.getLogger(__name__)

TOKEN_THERE = "CAIRN_TOKEN_THERE"  # noqa: S105 - the variable's name
CUTS_MAX = 6
"""Most rounds in a row that break without moving a commit or a part of one."""
WAIT_MAX_S = 60.0
"""Longest wait that a server may ask for; a longer one ends the command with the server's error."""
FOLDER_MB = 10_000.0
MEGABYTE = 1e6


def main(argv: list[str]) -> int:
    """Hand over once, or again and again."""
    args = _parser().parse_args(argv)
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    if "://" not in args.here + args.there:
        raise BadInputError("bad_url", "one of the two places must be a map's URL: http://HOST:PORT/maps/NAME")
    name = Path((args.here if "://" in args.here else args.there).rstrip("/")).name
    with ExitStack() as stack:
        here, there = (
            stack.enter_context(_place(text, tokens, name, size_bytes_max=int(args.folder_mb * MEGABYTE)))
            for text, tokens in ((args.here, args.token), (args.there, args.token_there.with_named_of(args.token)))
        )
        resting = Undelivered()
        report = _once(here, there, resting, map_name=name, where=args.there)
        backoff = Backoff()
        while args.every is not None:
            time.sleep(args.every)
            try:
                report = _once(here, there, resting, map_name=name, where=args.there)
                backoff.reset()
            except CairnError as exc:  # also nonsense, such as a portal's page in the place of an answer
                asked_s = exc.retry_after_s or 0.0 if isinstance(exc, UnreachableError) else 0.0
                wait_s = backoff.next_s(min(asked_s, REST_S))
                log.warning("no round (%s: %s); trying again in %.1f s", exc.kind, exc.message, wait_s)
                time.sleep(wait_s)
    return int(bool(report.kept_back or report.refused or report.split or any(map(resting.may_come_later, RelaySide))))


def _once(here: AttachmentEnd, there: AttachmentEnd, resting: Undelivered, *, map_name: str, where: str) -> RelayReport:
    """Rounds until there is nothing more to hand over; the sum of their reports."""
    total, backoff, cuts = RelayReport(has_more=True), Backoff(), 0
    while total.has_more:
        report = hold_between(relay_round(resting), here, there)
        log_report(report, map_name, there=where)
        total.has_more, total.split = report.has_more, report.split
        for side in RelaySide:
            total.moved[side] += report.moved[side]
        total.kept_back |= report.kept_back
        total.refused = (total.refused + report.refused)[:AT_ONCE]
        error = report.cut or report.later
        if error:  # a commit at which this happens twice rests, so that the next ones have their turn
            cuts = 1 if any(report.moved.values()) or error.kind == CAME_IN_PART else cuts + 1
            if cuts == CUTS_MAX or (error.retry_after_s or 0.0) > WAIT_MAX_S:
                raise error
            time.sleep(backoff.next_s(error.retry_after_s))
            total.has_more = True
    while hand_over_attachments(here, there):
        pass
    say(f"map {map_name}: {total.moved[RelaySide.THERE]} commits to {where}, {total.moved[RelaySide.HERE]} from there")
    return total


@contextmanager
def _place(text: str, tokens: OriginTokens, map_name: str, *, size_bytes_max: int) -> Iterator[AttachmentEnd]:
    if "://" not in text:
        yield CarriedCommits(Path(text), map_name, size_bytes_max=size_bytes_max)
        return
    server_url, map_name = split_map_url(text)
    with RelayApi(server_url, token=tokens.of(server_url)) as api:
        yield ServerEnd(api, map_name)


def _parser() -> argparse.ArgumentParser:
    added = parser("cairn relay", __doc__)
    added.add_argument("here", metavar="PLACE", help="a map's URL (http://HOST:PORT/maps/NAME) or a folder")
    added.add_argument("there", metavar="PLACE", help="another one")
    add_token(added, text="token of the first place")
    add_token(added, "--token-there", variable=TOKEN_THERE, text="token of the second place")
    added.add_argument("--every", type=float, metavar="SECONDS", help="go on, with this pause between rounds (once)")
    added.add_argument(
        "--folder-mb",
        type=float,
        default=FOLDER_MB,
        metavar="MB",
        help=f"size of a folder; when it is full, its oldest commits are dropped ({FOLDER_MB:.0f})",
    )
    return added
