"""The robot's side: local map, outbox, sync and the command line."""
