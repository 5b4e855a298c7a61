"""Maps as files: cells in a folder, and exports as PLY, PCD, LAZ, NPZ and OctoMap trees.

`export_request` selects the part of a map that is exported; serving it is left to the server. Start with `cell_folder`.
"""
