"""The map: grid, evidence, octree code, commits, and the frames and messages that carry them.

Sensors, networks and databases are left to the packages above. Start with `evidence.grid` (numbers of cells and
voxels), `evidence.evidence` (the counts and sums of one cell), `evidence.inverse_sensor_model` (their probability) and
`codec.cell_code` (a cell as bytes).
"""
