"""Commands of `cairn` that a robot's machine has: doctor, token, relay, compile, and shared arguments.

`maps/` holds the commands on maps, `robots/` those on a robot's folder. Start with `arguments`.
"""
