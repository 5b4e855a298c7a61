"""Cameras, rigs and their calibration: from images of a board to `rig.json`, its uncertainty and a report.

What is measured with a calibrated rig is left to `cairn_fusion`. Start with `rig.rig` (the result) and `solve.solve`
(the pipeline); CONVENTIONS.md fixes frames, pixels and units.
"""
