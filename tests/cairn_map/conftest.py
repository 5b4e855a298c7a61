"""Hypothesis without a deadline (the first call of a kernel compiles it) and without a database."""

from hypothesis import HealthCheck, settings

settings.register_profile(
    "cairn", max_examples=50, deadline=None, database=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("cairn")
