"""Maps as files: cells in a folder, and exports as PLY, PCD, LAZ, NPZ and OctoMap trees.

Which part of a map is exported is asked of `export_request`; serving it is the server's. Start with `cell_folder`.
"""
