"""Cameras, rigs and their calibration."""
