"""Files for who runs the server: systemd's units, read by systemd itself, and the limits of the compose files."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from cairn_server.operations.serve_options import serve_parser

ROOT = Path(__file__).resolve().parent.parent
UNITS = ROOT / "docs" / "systemd"
COMPOSE = [ROOT / "docker" / name for name in ("compose.yaml", "compose.scale.yaml")]
EXPOSURE_MAX = 30
"""Highest exposure by `systemd-analyze security`, in tenths: 29 is "OK", a unit without hardening has 96."""


@pytest.fixture
def units(tmp_path: Path) -> list[Path]:
    """The units, of the cairn that is installed here."""
    if shutil.which("systemd-analyze") is None:
        pytest.skip("systemd-analyze is missing")
    for path in UNITS.iterdir():
        text = path.read_text().replace("/opt/cairn/bin/cairn", f"{sys.prefix}/bin/cairn")
        (tmp_path / path.name).write_text(text.replace("User=cairn", "User=root"))
    return sorted(tmp_path.iterdir())


@pytest.mark.processes
def test_systemd_takes_the_units_as_they_are(units: list[Path]) -> None:
    done = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", *units], capture_output=True, text=True, check=False
    )
    ours = [line for line in done.stderr.splitlines() if "cairn" in line]
    assert (done.returncode, ours) == (0, []), done.stderr


@pytest.mark.processes
def test_systemd_finds_the_units_hardened(units: list[Path]) -> None:
    services = [path for path in units if path.suffix == ".service"]
    for path in services:
        command = ["systemd-analyze", "security", "--offline=true", f"--threshold={EXPOSURE_MAX}", path]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout[-2000:] + done.stderr


def test_the_unit_of_the_server_gives_options_that_it_has() -> None:
    (line,) = re.findall(r"^ExecStart=\S+ serve (.*)$", (UNITS / "cairn-server.service").read_text(), re.MULTILINE)
    serve_parser(None).parse_args(line.split())


@pytest.mark.parametrize("path", COMPOSE, ids=lambda path: path.stem)
def test_every_container_has_limits(path: Path) -> None:
    for name, service in yaml.safe_load(path.read_text())["services"].items():
        missing = {"mem_limit", "cpus", "pids_limit", "logging"} - service.keys()
        assert not missing, f"{name} has no {missing}"
        assert {"max-size", "max-file"} <= service["logging"]["options"].keys(), name
    assert yaml.safe_load(path.read_text())["services"]["proxy"]["read_only"]
