"""Simulated robots in a room that is known exactly."""
