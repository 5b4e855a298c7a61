"""A connection whose link drops everything is given up by the kernel, after the time that the store's URL says."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = [pytest.mark.processes, pytest.mark.slow]

ROOT = Path(__file__).parents[2]
SOON = "?keepalives_idle=1&keepalives_interval=1&keepalives_count=2&tcp_user_timeout=2000"
SOON_S = 8.0
"""Of some 3 s, on a machine that does much else."""
PREPARE = "ip link set lo up && iptables --list"


def in_namespace(script: str) -> subprocess.CompletedProcess[str]:
    command = ["unshare", "--net", "sh", "-c", script]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False, cwd=ROOT)


def refusal() -> str:
    """Why this machine cannot; empty if it can."""
    missing = [name for name in ("unshare", "ip", "iptables") if shutil.which(name) is None]
    if missing:
        return f"no {', '.join(missing)}"
    tried = in_namespace(PREPARE)
    return f"no packets can be dropped in a network namespace here: {tried.stderr.strip()}" if tried.returncode else ""


def test_a_statement_over_a_link_that_is_cut_without_a_word_fails_within_seconds() -> None:
    if why := refusal():
        pytest.skip(why)
    done = in_namespace(f"{PREPARE} >&2 && {sys.executable} -m tests.replicas.silent_cut '{SOON}'")
    assert done.returncode == 0, done.stderr
    asking_s, waiting_s = map(float, done.stdout.split())
    assert max(asking_s, waiting_s) < SOON_S
