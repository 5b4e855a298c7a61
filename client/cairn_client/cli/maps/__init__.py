"""Commands on maps: create, list, export, query, render, retract, clone, pull, diff, watch.

Robots' folders are left to `cli.robots`. Start with `command`, which is `cairn map`.
"""
