"""LZF decompression (Marc Lehmann's liblzf), which compressed PCD files use.

000lllll                      l + 1 bytes follow as they are
lllooooo oooooooo             copy l + 2 bytes from o + 1 bytes back, l = 1 .. 6
111ooooo llllllll oooooooo    copy l + 9 bytes from o + 1 bytes back
"""

import numba
import numpy as np
import numpy.typing as npt


@numba.njit(cache=True)
def decompress_into(packed: npt.NDArray[np.uint8], out: npt.NDArray[np.uint8]) -> int:
    """Count of bytes written to `out`, or -1 if the bytes are damaged or more than fit."""
    source, target = 0, 0
    while source < len(packed):
        control = int(packed[source])
        source += 1
        if control < 32:
            # Bytes as they are.
            length = control + 1
            if source + length > len(packed) or target + length > len(out):
                return -1
            for _ in range(length):
                out[target] = packed[source]
                source += 1
                target += 1
            continue
        # A copy: its length, in a byte of its own if it is long, and how far back it begins.
        length = control >> 5
        if length == 7:
            if source >= len(packed):
                return -1
            length += int(packed[source])
            source += 1
        length += 2
        if source >= len(packed):
            return -1
        back = target - ((control & 31) << 8) - int(packed[source]) - 1
        source += 1
        if back < 0 or target + length > len(out):
            return -1
        # Byte by byte, since a copy may overlap the place it is written to.
        for _ in range(length):
            out[target] = out[back]
            back += 1
            target += 1
    return target
