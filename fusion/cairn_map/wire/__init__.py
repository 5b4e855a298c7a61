"""Messages and frames that client and server both speak (PROTOCOL.md), without any I/O.

Sending is left to `cairn_client.http`, answering to `cairn_server.http`. Start with `frames` (cells on their way) and
`messages` (everything in JSON).
"""
