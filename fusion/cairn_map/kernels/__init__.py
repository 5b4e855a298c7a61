"""Foundations of compiled code: Morton codes, integer casts, and Numba at run time (progress, Ctrl-C).

The kernels themselves lie in the rooms that use them, in files named `*_kernels.py`. Start with `morton_kernels`.
"""
