"""Evidence: integer sums per voxel of a numbered grid, how they merge, and how they are read as probabilities.

Bytes are left to `codec`, queries to `queries`. Start with `grid`, then `evidence` and `inverse_sensor_model`
(OctoMap's, over two counters); `evidence_map` is a whole map in memory.
"""
