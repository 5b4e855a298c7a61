"""Epochs: spans of capture time, all of one length in a map, whose evidence is kept apart.

    epoch = floor(time of the last scan / epoch_s)              rule T1, made by the author of a commit

Evidence without a time (prior data, a robot that never learnt the server's clock, commits of format version 1) is in
the *base*, which is older than every epoch.
"""

import math
from typing import NewType

import numpy as np

from cairn_map.arrays import Floats, Ints
from cairn_map.errors import BadInputError

Epoch = NewType("Epoch", int)
"""Number of an epoch, rising in time; 0 begins at 1970-01-01 UTC."""

BASE = Epoch(-(1 << 63))
"""Epoch of evidence without a time: the least integer of its 64 bits, so that it sorts first."""
EPOCH_MAX = 1 << 40
"""Largest magnitude of an epoch: 35 000 years, in epochs of a second."""
EPOCH_S_MAX = 366 * 86_400
"""Longest epoch, seconds."""
STANDARD_EPOCH_S = 120
"""Length of an epoch in new maps, seconds: shorter ones find out sooner that something has gone, and cost bytes."""


def epoch_of(time_s: float, epoch_s: int) -> Epoch:
    """Epoch of a time.

    Args:
        time_s: UTC seconds since 1970.
        epoch_s: length of the map's epochs, seconds.

    Raises:
        BadInputError: kind `bad_epoch`: not finite, or beyond `EPOCH_MAX` epochs.
    """
    epoch = EPOCH_MAX + 1
    if math.isfinite(time_s):
        # The quotient may be rounded up to the next epoch: of a time just before it, or of one as near to 0 as can be.
        epoch = math.floor(time_s / epoch_s)
        epoch -= epoch * epoch_s > time_s
    if abs(epoch) > EPOCH_MAX:
        raise BadInputError(
            "bad_epoch", f"a time must be within {EPOCH_MAX} epochs of {epoch_s} s of 1970, got {time_s}"
        )
    return Epoch(epoch)


def begin_s(epoch: Epoch, epoch_s: int) -> float:
    """First instant of an epoch, UTC seconds since 1970; minus infinity for the base."""
    return -math.inf if epoch == BASE else float(epoch * epoch_s)


def times_of_epochs(epochs: Ints, epoch_s: int) -> Floats:
    """First instants of epochs, UTC seconds since 1970; NaN for the base, whose evidence has no time."""
    is_base = epochs == BASE
    return np.where(is_base, np.nan, np.where(is_base, 0, epochs) * np.float64(epoch_s))


def check_epoch(epoch: int) -> Epoch:
    """The epoch of a number that came from outside.

    Raises:
        BadInputError: kind `bad_epoch`.
    """
    if epoch != BASE and abs(epoch) > EPOCH_MAX:
        raise BadInputError("bad_epoch", f"an epoch is at most {EPOCH_MAX} from 0, or the base, got {epoch}")
    return Epoch(epoch)
