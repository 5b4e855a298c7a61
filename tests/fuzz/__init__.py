"""Fuzzing: bytes that nobody would write, at every decoder, guided by what they reach.

    $ make soak                                  # every target ten minutes, two at a time
    $ make soak SOAK_SECONDS=60 SOAK_ARGS=cell   # one minute of one target

Coverage is that of Python lines and branches (atheris, which is libFuzzer for Python). Kernels are compiled by Numba
and not instrumented: what they do steers nothing. Instead they run with their array bounds checked, compiled into a
folder of their own, so that a read or write beside an array is a finding too.
"""
