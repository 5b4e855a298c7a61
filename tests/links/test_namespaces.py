"""The same over the kernel's own TCP, in a network namespace: a narrow rate, packets dropped at random.

lo of the namespace: 1500 bytes a packet, tbf 2 Mbit/s, iptables drops 5 % of what comes in
"""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.processes

ROOT = Path(__file__).parents[2]
LOSS = 0.05
PREPARE = (
    "ip link set lo mtu 1500 up && tc qdisc add dev lo root tbf rate 2mbit burst 16kb latency 400ms && "
    f"iptables -A INPUT -p tcp -m statistic --mode random --probability {LOSS} -j DROP"
)
RUN = f"{sys.executable} -m tests.links --minutes 0.05 --robot tof --voxel 0.16 --stops 3 --seed 1 --no-faults"


def in_namespace(script: str) -> subprocess.CompletedProcess[str]:
    command = ["unshare", "--net", "sh", "-c", script]
    return subprocess.run(command, capture_output=True, text=True, timeout=240, check=False, cwd=ROOT)


def refusal() -> str:
    """Why this machine cannot; empty if it can."""
    missing = [name for name in ("unshare", "ip", "tc", "iptables") if shutil.which(name) is None]
    if missing:
        return f"no {', '.join(missing)}"
    tried = in_namespace(PREPARE)
    return f"no rates and losses in a network namespace here: {tried.stderr.strip()}" if tried.returncode else ""


def test_robots_on_a_link_that_drops_packets_all_end_with_the_sum_of_all_commits() -> None:
    if why := refusal():
        pytest.skip(why)
    done = in_namespace(f"{PREPARE} && {RUN}; code=$?; iptables -L -v -n >&2; exit $code")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "0 things wrong" in done.stdout
