"""Maps as files: cells in a folder, and exports as PLY, PCD, LAZ, NPZ and OctoMap trees.

The part of a map that is exported is defined by `export_request`; serving it is left to the server. Start with `cell_folder`.
"""
