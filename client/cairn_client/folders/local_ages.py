"""How old what a robot's own map shows is, without a server: by the commits whose bytes the robot still keeps.

    commit --captured_s, its cells' voxels--> when each 4^3 block was measured last

What other robots measured came as sums without a time, and of its own commits a robot forgets the bytes once no restore
can lose them: there the age is unknown, which is grey and fades nothing. The server's age layer knows them all.
"""

import math

import numpy as np
import numpy.typing as npt

from cairn_client.replica.replica import Replica
from cairn_map.codec.cell_code import decode_cell
from cairn_map.evidence.grid import CellKey
from cairn_map.render.map_picture import Ages


def ages_of(replica: Replica) -> Ages | None:
    """When each block of a robot's map was measured by itself, UTC seconds, and the newest of these times as now.

    None where no commit that is kept states a time. What was taken out, or amended, does not count.

    Raises:
        DamagedDataError: a commit at rest is not sound.
    """
    blocks = 8 ** (replica.geometry.depth - 2)
    changes: dict[CellKey, npt.NDArray[np.float64]] = {}
    newest_s = -math.inf
    with replica.lock:
        for kept in replica.outbox:
            if replica.outbox.successors.of(kept.id) is not None or not kept.cells:
                continue
            commit = replica.kept_commit(kept.id)
            if commit is None or commit.meta.captured_s is None:
                continue
            captured_s = commit.meta.captured_s[1]
            newest_s = max(newest_s, captured_s)
            for key, data in commit.cells.items():
                touched = np.unique(decode_cell(data).evidence.voxels >> np.uint32(6))
                known = changes.setdefault(key, np.full(blocks, np.nan))
                known[touched] = np.fmax(known[touched], captured_s)
    return Ages(changes, now=newest_s) if changes else None
