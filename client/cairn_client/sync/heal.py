"""Cells that the server's disk damaged for good, sent back by whoever still has them.

The server says what it lacks: the cell, and the fingerprint that it had. A base of that fingerprint is the cell; the
server takes it for its SHA-256 alone, so nobody has to be trusted, and whoever is wrong changes nothing.
"""

import logging

from cairn_client.replica.replica import Replica
from cairn_client.sync.requests import Conversation, PutCell
from cairn_map.codec.cell_code import encode_cell
from cairn_map.errors import CairnError, DeniedError, UnreachableError
from cairn_map.evidence.fingerprint import fingerprint
from cairn_map.evidence.grid import Cell, CellKey, cell_key

log = logging.getLogger(__name__)


def heal_damaged(replica: Replica) -> Conversation[int]:
    """Send what the newest header calls damaged and this robot holds as it was; how many cells were.

    Raises:
        UnreachableError: the link broke; the others are sent next time.
        DeniedError: the server does not know this robot.
    """
    healed = 0
    for cell, wanted in replica.header.damaged if replica.header else []:
        key = cell_key(cell)
        body = None if (key, wanted) in replica.refused_cells else _body(replica, key, wanted)
        if body is None:
            continue
        try:
            yield from PutCell(Cell(*cell), body)
        except (UnreachableError, DeniedError):
            raise
        except CairnError as exc:
            log.error("the server will not take cell %s, which it calls damaged: %s", Cell(*cell), exc.message)
            replica.refused_cells.add((key, wanted))
        else:
            log.warning("the server had damaged cell %s; sent it from here", Cell(*cell))
            healed += 1
    return healed


def _body(replica: Replica, key: CellKey, wanted: str) -> bytes | None:
    """The cell as the server had it, if that is what is held, and if it is sound itself."""
    with replica.lock:
        held = replica.cells.get(key)
        if held is None or held.fingerprint.hex() != wanted:
            return None
        evidence = replica.base_evidence(key)
    if fingerprint(evidence, key).hex() != wanted:
        return None
    return encode_cell(key, evidence, replica.geometry).data
