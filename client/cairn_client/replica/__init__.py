"""Replica: a robot's durable copy of the server's map, its own commits, and the view of both.

Talking to a server is left to `sync`. Start with `replica`; `outbox` keeps commits until they are safe.
"""
