"""Attachments of marks between the two places of a relay, after the commits that name them.

Each place says what it wants; what the other one has goes there. Nothing is remembered: a place that lost its
attachments wants them again, and bytes that lie are found by their SHA-256, wherever they come from.
"""

import logging

from cairn_map.commits.attachment import Attachment
from cairn_map.errors import CairnError, UnreachableError
from cairn_map.wire.relay_peer import AttachmentEnd

log = logging.getLogger(__name__)

AT_ONCE = 64
"""Attachments handed over in each direction in one round."""


def hand_over_attachments(here: AttachmentEnd, there: AttachmentEnd) -> int:
    """Hand over what either place wants and the other has; their count. What one place refuses, the other keeps.

    Raises:
        UnreachableError: the link broke; what was handed over stays so.
    """
    return give_attachments(here, there) + give_attachments(there, here)


def give_attachments(source: AttachmentEnd, target: AttachmentEnd) -> int:
    """Hand over what one place wants and the other has; as `hand_over_attachments`."""
    if not source.has_attachments():  # then no place is asked: a map without attachments costs no request
        return 0
    try:
        wanted = target.wanted_attachments()
    except UnreachableError:
        raise
    except CairnError as exc:  # such as a server that knows no attachments
        log.info("no attachments go there: %s", exc.message)
        return 0
    count = 0
    for attachment in wanted:
        if count == AT_ONCE:
            break
        try:
            count += _move(attachment, source, target)
        except UnreachableError as exc:
            if exc.kind == "no_link":
                raise
            log.warning("attachment %s waits: %s", attachment.sha256, exc.message)
        except CairnError as exc:
            log.error("attachment %s is not handed over: %s", attachment.sha256, exc.message)
    return count


def _move(attachment: Attachment, source: AttachmentEnd, target: AttachmentEnd) -> bool:
    """Hand over one attachment; False if the source does not have it."""
    data = source.attachment(attachment)
    if data is None or len(data) != attachment.size_bytes:
        return False
    target.keep_attachment(attachment, data)
    return True
