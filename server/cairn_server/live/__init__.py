"""Live state: who listens to a map, what changed, where robots are and what they report.

Sending it is left to `http.routes.live`. Start with `hub`.
"""
