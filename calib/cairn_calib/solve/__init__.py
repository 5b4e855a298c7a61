"""Calibration solve: homographies, Zhang's start, each camera alone, then all of them with range bias.

Judging a solution is left to `diagnosis`. Start with `solve`, the list of stages; `adjustment` is the solver.
"""
