"""The map server."""
