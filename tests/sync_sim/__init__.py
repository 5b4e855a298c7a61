"""Robots and a server in virtual time: the real rules on both sides, and links, disks and clocks that fail.

    $ python -m tests.sync_sim                 # 100 000 seeds, on all processors
    $ python -m tests.sync_sim --seed 4711     # one, step by step

A seed is a whole history: who maps, syncs, folds, undoes, restores a backup or loses a disk, and which messages are
lost, late, doubled or cut at which byte. Nothing waits for a real clock, and the same seed does the same again.
"""
