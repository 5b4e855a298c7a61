"""Sync protocol of a robot (server/SYNC.md) as conversations without I/O: push, fetch missing, apply frames.

Sockets are left to `http`. Start with `sync`, one round; `exchange` applies frames to a replica.
"""
