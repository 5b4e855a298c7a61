"""Relays: signed commits from one server to another, over a link or carried by a robot.

A robot's own commits are pushed by `sync`. Start with `round`.
"""
