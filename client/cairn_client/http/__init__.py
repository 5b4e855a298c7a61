"""HTTP link to a map server: requests, retries, live events.

What is said over it is `sync`'s. Start with `api`.
"""
