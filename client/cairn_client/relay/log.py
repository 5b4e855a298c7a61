"""What a relay says of its rounds, in a few lines for whoever runs it."""

import logging
from collections.abc import Iterable
from itertools import islice

from cairn_client.relay.round import RelayReport, Side, Why

log = logging.getLogger(__name__)
NAMED_MAX = 3
PAUSE_S = 60.0
"""A server that wants a shorter one is only busy."""
SAID = {
    Why.GONE: "are not kept any more where they are, so one of the two maps is without them; start the server that "
    "lacks them from a copy of the other (cairn serve backup, restore)",
    Why.UNSIGNED: "are not signed and stay where they are: their robots are of an older version",
}


def tell(report: RelayReport, map_name: str, *, there: str) -> None:
    """One line for each thing that somebody may have to know; none for a round in which nothing happened."""
    taken, given = report.moved[Side.HERE], report.moved[Side.THERE]
    if taken or given:
        log.info("map %s: %d commits to %s, %d from there", map_name, given, there, taken)
    for (_, why), commits in report.kept_back.items():
        log.error("map %s: %d commits (%s) %s", map_name, len(commits), _names(commits), SAID[why])
    if report.later and (report.later.retry_after_s or 0.0) >= PAUSE_S:
        log.warning("map %s: no more for now, %s", map_name, report.later.message)
    if report.refused:
        commit, error = report.refused[0]
        log.error("map %s: %d commits refused, such as %s: %s", map_name, len(report.refused), commit, error.message)
    if report.split:
        log.error(
            "map %s: the two servers have other commits under the same ids, of %s: such a robot's disk was rolled "
            "back. Compare `cairn map log` of both; a retract of these ids makes the maps equal again",
            map_name,
            _names(report.split),
        )


def _names(found: Iterable[object]) -> str:
    some = [str(one) for one in islice(found, NAMED_MAX + 1)]
    return ", ".join(some[:NAMED_MAX]) + (" ..." if len(some) > NAMED_MAX else "")
