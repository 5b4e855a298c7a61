"""Attachments of one robot's marks on their way to its server, and until no restore of that can lose them.

    kept in the folder    until no kept commit names it, and the server does not want it
    sent                  at the end of a round, some megabytes at a time

A server that was restored wants it again while the commit that names it could be lost, too.
"""

import logging

from cairn_client.http.api import MapApi
from cairn_client.http.attachment_copy import PART_BYTES, sent_parts
from cairn_client.replica.replica import Replica
from cairn_map.errors import CairnError, UnreachableError

log = logging.getLogger(__name__)

AT_ONCE_BYTES = 1 << 22
"""Bytes after which a round leaves the rest to the next one: commits have their turn in between."""


def bring_attachments(api: MapApi, replica: Replica, map_name: str, at_once_bytes: int) -> bool:
    """Send what the server wants of the attachments here, and drop what need not be kept; True if there is more.

    A server that wants none costs a robot without attachments nothing.

    Raises:
        UnreachableError: the link broke; what came of an attachment stays at the server.
    """
    kept = replica.attachments.names()
    if not kept:
        return False
    try:
        answer = api.wanted_attachments(map_name, robot=replica.author.robot)
    except UnreachableError:
        raise
    except CairnError as exc:  # such as a server that knows no attachments
        log.warning("attachments wait, the server of map %s does not ask for any: %s", map_name, exc.message)
        return False
    lacking = {each.sha256 for each in answer.wanted}
    left_bytes = at_once_bytes
    for attachment in answer.wanted:
        data = replica.attachments.read(attachment.sha256) if attachment.sha256 in kept else None
        if data is None or len(data) != attachment.size_bytes:
            continue
        try:
            for held_bytes in sent_parts(api, map_name, attachment, data):
                left_bytes -= PART_BYTES
                if left_bytes < 0 and held_bytes < len(data):
                    return True
            lacking.discard(attachment.sha256)
        except UnreachableError:
            raise
        except CairnError as exc:  # it stays here, and others have their turn
            log.error("attachment %s is refused, and kept here: %s", attachment.sha256, exc.message)
    if not answer.more:
        for sha256 in kept - lacking - replica.named_attachments():
            replica.attachments.drop(sha256)
    return False
