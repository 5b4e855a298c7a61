"""Native queries: a snapshot asked point by point by compiled code, in C, C++ or Numba, without Python in between.

Queries of many points in one call are `queries`'. Start with `point_handle`; `cairn_points.h` is the C side of it.
"""
