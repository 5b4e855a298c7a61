"""What a relay says of its rounds, in a few lines for whoever runs it."""

import logging
from collections.abc import Sequence

from cairn_client.relay import RelayReport, Side

log = logging.getLogger(__name__)
NAMED_MAX = 3


def tell(report: RelayReport, map_name: str, *, there: str) -> None:
    """One line for each thing that somebody may have to know; none for a round in which nothing happened."""
    taken, given = report.moved[Side.HERE], report.moved[Side.THERE]
    if taken or given:
        log.info("map %s: %d commits to %s, %d from there", map_name, given, there, taken)
    if report.gone:
        log.error(
            "map %s: %d commits (%s) are not kept any more where they are, so one of the two maps is without them; "
            "start the server that lacks them from a copy of the other (cairn serve backup, restore)",
            map_name,
            len(report.gone),
            _names(report.gone),
        )
    if report.unsigned:
        log.error(
            "map %s: %d commits (%s) are not signed and stay where they are: their robots are of an older version",
            map_name,
            len(report.unsigned),
            _names(report.unsigned),
        )
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


def _names(found: Sequence[object]) -> str:
    return ", ".join(map(str, found[:NAMED_MAX])) + (" ..." if len(found) > NAMED_MAX else "")
