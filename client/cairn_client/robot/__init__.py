"""Robot: the public class, its rounds with the server, limits, events, amends and alignment.

Its durable state is `replica`'s. Start with `robot`.
"""
