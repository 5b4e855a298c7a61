"""Evidence by epoch of capture, and its reading: now, at a time, and what changed between two times.

A cell's sums, without time, are `evidence`; the bytes are `codec`. Start with `cell_history.py`, the value; then
`history_cell.py` and `history_map.py`, to which commits are added, and `present.py`, the reading, which
`cell_reading.py` and `map_reading.py` keep up to date.
"""
