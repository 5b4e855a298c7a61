"""Commands on robots: replay and run recordings, sync, status, queue, telepresence, verification.

Maps are left to `cli.maps`. Start with `command`, which is `cairn robot`.
"""
