"""What a map is: grid, evidence, octree code, commits, and the frames and messages that carry them.

Sensors, networks and databases are left to the packages above. Start with `evidence.grid` (where things are numbered),
`evidence.evidence` (what is counted there) and `codec.cell_code` (how a cell becomes bytes).
"""
