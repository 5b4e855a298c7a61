"""`cairn demo`: three robots and a server that build one map and prove that it is the same everywhere.

It starts real programs only. Start with `command`.
"""
