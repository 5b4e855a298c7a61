"""Middleware around every request: deadlines, log, origin, version, size of the body, token.

Answers are left to `http.routes`. Start with `request_trail`.
"""
