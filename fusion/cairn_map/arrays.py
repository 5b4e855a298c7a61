"""Array types by their element: the aliases that signatures use, one meaning each in the whole tree.

Shapes stand in the docstrings, in the letters of STYLE.md: `N` points, `H, W` image rows and columns, `V` voxels.
"""

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Singles = npt.NDArray[np.float32]
Ints = npt.NDArray[np.int64]
Int32s = npt.NDArray[np.int32]
Flags = npt.NDArray[np.bool_]
Bytes = npt.NDArray[np.uint8]
Labels = npt.NDArray[np.uint8]
"""One class for each pixel or point, out of an enumeration."""
Rgb = npt.NDArray[np.uint8]
"""(H, W, 3) or (N, 3): red, green, blue as sRGB."""
Counts = npt.NDArray[np.uint16]
"""Hits and misses of voxels."""
Words = npt.NDArray[np.uint64]
Words32 = npt.NDArray[np.uint32]
