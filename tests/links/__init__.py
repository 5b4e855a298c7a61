"""Links that fail all day, and programs that are killed: real robots, a real server, and a proxy between them.

    $ python -m tests.links --minutes 30           # `make soak`: delays, cuts, half-closed and reset connections
    $ python -m tests.links --minutes 15 --kill    # the same, and robots and server are killed at any instant

Ends with 1 unless all robots and the server have the same map, byte for byte, and it is the sum of all commits, each
of them once.
"""
