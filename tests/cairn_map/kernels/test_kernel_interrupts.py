"""^C while a kernel runs, in a process of its own: a signal is the whole process's."""

import signal
import subprocess
import sys

import pytest

pytestmark = pytest.mark.processes

RUN_KERNELS = """
import sys
import numpy as np
from numba import njit
from cairn_map.kernels.numba_runtime import keep_interrupts_out_of_kernels

@njit
def two_arrays(rounds):
    x = np.uint64(1)
    for i in range(rounds):
        x = (x ^ (x >> np.uint64(7))) * np.uint64(6364136223846793005) + np.uint64(i)
    return np.full(2, x), np.full(3, x)

keep_interrupts_out_of_kernels()
two_arrays(1)
try:
    print("ready", flush=True)
    while True:
        two_arrays(30_000_000)
except KeyboardInterrupt:
    sys.exit(130)
"""
TIMES = 3


def test_an_interrupt_while_a_kernel_runs_comes_after_it() -> None:
    for _ in range(TIMES):
        with subprocess.Popen(
            [sys.executable, "-c", RUN_KERNELS], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        ) as process:
            assert process.stdout is not None and process.stdout.readline() == "ready\n"
            process.send_signal(signal.SIGINT)
            _, err = process.communicate(timeout=60)
        assert process.returncode == 130, err
