"""`cairn doctor`: checks of a machine, a server and a robot's folder, each with its remedy.

`checks` has those of one server, `site` those of several that share a database. Start with `command`.
"""
