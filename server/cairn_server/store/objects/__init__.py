"""Object store behind a database: immutable bytes under names that are used once, and their errors.

Which bytes move there, and when, is the matter of `settling`; rows of the database name the objects. Start with
`cold_bytes`.
"""
