"""Examination of a solution before it is trusted: weak modes, cross-validation, influence, warnings.

Writing it down is left to `report`. Start with `examination`, which runs all of it.
"""
