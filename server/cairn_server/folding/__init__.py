"""Folding: pending commits become log entries and cells, in a thread and a process of their own.

Accepting commits is left to `sync`. Start with `folding`, which is pure, then `fold_thread`; `fold_lanes` says
which commits wait for which.
"""
