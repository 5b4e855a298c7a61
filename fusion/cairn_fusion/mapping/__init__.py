"""Scans as evidence: hits, certainly free space, colour and temperature per voxel.

The sums live in `cairn_map.evidence`, as does the inverse sensor model, which reads them as probabilities. Start with
`integrate`, the pipeline, then `free_space` and `samples`.
"""
