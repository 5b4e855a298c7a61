"""A crowd of robots on one server: that it answers all of them in time, makes no error, and does not grow.

    $ make soak                                                # with the rest of the soak
    $ python -m tests.crowd --robots 200 --seconds 600         # alone

building       real diffs of single scans of the simulated building, and its map of 56 cells
link           one connection, HTTP and frames as bytes: who asks shares the processors with who is asked
crowd          robots in rounds (push, missing, status), and listeners to live events
whole_robots   a few robots with `cairn_client` and all: what was sent makes the server's map, byte for byte
watch          the server's memory and processor time, from outside
verdict        the bars, and the figures behind them
"""
