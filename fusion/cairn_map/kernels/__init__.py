"""Ground of all compiled code: Morton codes, integer casts, and how compilation is reported.

The kernels themselves lie in the rooms that use them, in files named `*_kernels.py`. Start with `morton_kernels`.
"""
