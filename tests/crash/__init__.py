"""Crashes: what was acknowledged is there afterwards, whatever the machine was doing.

    $ make soak                                       # with the rest of the soak
    $ python -m tests.crash --trials 1000             # power cuts
    $ python -m tests.crash --kills 200               # kill -9 of real servers
    $ python -m tests.crash --trials 100 --level OFF  # what the same trials find where nothing is flushed

power_cut   a disk that keeps unsynced writes apart, and loses, tears and reorders them at the cut (an apsw VFS)
lives       a store on that disk, pushed to and folded by threads until the cut; again on what the cut left
verdict     what must hold of the store that is left in the end
kills       the same with `kill -9` and real servers behind real sockets
"""
