"""Access: tokens and roles, quotas and rate limits.

Enforcing them on a request is left to `http`. Start with `auth`.
"""
