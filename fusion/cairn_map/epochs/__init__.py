"""Evidence by epoch of capture, and its reading: now, at a time, and what changed between two times.

A cell's sums, without time, are `evidence`; the bytes are `codec`. Start with `cell_history.py`, then `present.py`.
"""
