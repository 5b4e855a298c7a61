"""Calibration study: which images of the board calibrate a rig best, by simulated calibrations.

The solver is `cairn_calib.solve`. Start with `run`.
"""
