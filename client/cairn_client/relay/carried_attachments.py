"""Attachments of marks between the two places of a relay, after the commits that name them.

Each place says what it wants; what the other one has goes there. Nothing is remembered: a place that lost its
attachments wants them again, and bytes that lie are found by their SHA-256, wherever they come from.
"""

import logging
from collections.abc import Collection

from cairn_map.commits.attachment import Attachment
from cairn_map.errors import CairnError, UnreachableError
from cairn_map.wire.relay_peer import AttachmentEnd

log = logging.getLogger(__name__)

AT_ONCE = 64
"""Attachments handed over in each direction in one round."""


def hand_over_attachments(here: AttachmentEnd, there: AttachmentEnd) -> int:
    """Hand over what either place wants and the other has, some at a time; their count.

    Raises:
        UnreachableError: the link broke; what was handed over stays so.
    """
    return len(give_attachments(here, there)) + len(give_attachments(there, here))


def give_all_attachments(source: AttachmentEnd, target: AttachmentEnd) -> None:
    """Hand over all that one place wants and the other has, each once, though it may be wanted again at once.

    Raises:
        UnreachableError: as `hand_over_attachments`.
    """
    handed: set[str] = set()
    while moved := give_attachments(source, target, but_not=handed):
        handed |= moved


def give_attachments(
    source: AttachmentEnd, target: AttachmentEnd, *, but_not: Collection[str] = frozenset()
) -> set[str]:
    """Hand over some of what one place wants and the other has; their SHA-256. What is refused, the source keeps.

    Raises:
        UnreachableError: as `hand_over_attachments`.
    """
    if not source.has_attachments():  # then no place is asked: a map without attachments costs no request
        return set()
    try:
        wanted = target.wanted_attachments()
    except UnreachableError:
        raise
    except CairnError as exc:  # such as a server that knows no attachments
        log.info("no attachments go there: %s", exc.message)
        return set()
    moved: set[str] = set()
    for attachment in wanted:
        if len(moved) == AT_ONCE:
            break
        try:
            if attachment.sha256 not in but_not and _move(attachment, source, target):
                moved.add(attachment.sha256)
        except UnreachableError as exc:
            if exc.kind == "no_link":
                raise
            log.warning("attachment %s waits: %s", attachment.sha256, exc.message)
        except CairnError as exc:
            log.error("attachment %s is not handed over: %s", attachment.sha256, exc.message)
    return moved


def _move(attachment: Attachment, source: AttachmentEnd, target: AttachmentEnd) -> bool:
    """Hand over one attachment; False if the source does not have it."""
    data = source.attachment(attachment)
    if data is None or len(data) != attachment.size_bytes:
        return False
    target.keep_attachment(attachment, data)
    return True
