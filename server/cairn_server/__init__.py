"""The map server: it keeps commits, adds them up, and sends every robot what it misses.

What a map is comes from `cairn_map`. Start with `service` (the whole in one object), `sync.pushes` (a commit on its
way in) and `sync.missing` (a branch's difference to main); PROTOCOL.md is the specification.
"""
