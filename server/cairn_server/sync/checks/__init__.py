"""Checks of a commit before it is acknowledged, bounded in time and memory.

Keeping the commit is left to `sync.pushes`. Start with `commit_checks`.
"""
