"""Thermal radiometry: from a camera's counts to temperatures, and the calibration of that relation.

The record that a rig carries is `rig.radiometry`. Start with `response_fit`, then `object_temperature`.
"""
