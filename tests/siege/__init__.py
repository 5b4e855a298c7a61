"""Attacks of full size on a server that serves honest robots meanwhile; `python -m tests.siege`, of `make soak`.

The same at a size that runs in seconds: `tests/cairn_server/http/test_reachable.py`, `operations/test_strangers.py`.
"""
