"""Calibration report: tables and plots of a solve as one HTML file and as JSON.

The numbers are `solve`'s and `diagnosis`'s. Start with `solve_report`.
"""
