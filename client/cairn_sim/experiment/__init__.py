"""The paper's experiment: 54 measurements, 56 cells, three resolutions, with its tables and figures.

Scores come from `evaluation`. Start with `run`, then `tables`.
"""
