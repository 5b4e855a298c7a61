"""Attack a server in every way, one after the other, and say how honest robots fared; ends with 1 where they did not.

$ python -m tests.siege --seconds 20            # `make soak`
$ python -m tests.siege --seconds 5 missing
"""

import argparse
import signal
import ssl
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

import httpx
from tests.fixtures.map.made import SMALL
from tests.fixtures.server.access import ADMIN, ENROLLER, bearer
from tests.fixtures.server.live import Process
from tests.fixtures.server.memory_watch import MemoryWatch
from tests.siege.attacks import ATTACKS
from tests.siege.honest import HonestLoad, Waits

from cairn_map.wire.messages import CreateMap
from cairn_server.memory_shares import memory_shares

ROBOTS = 4
HEALTHY_S, STOPPED_S, SLOWER = 1.0, 10.0, 3.0
"""What must hold: of /healthz, of SIGTERM, and of honest robots' p99 compared with quiet times."""
DESCRIPTORS = 1024


@dataclass(frozen=True, slots=True)
class Fortress:
    """A server and who may use it."""

    process: Process
    url: str
    tokens: dict[str, str]
    verify: str | bool


def main() -> int:
    """Attack, and print what came of it."""
    parser = argparse.ArgumentParser("python -m tests.siege", description=__doc__)
    parser.add_argument("attacks", nargs="*", default=list(ATTACKS), help="which; default all")
    parser.add_argument("--seconds", type=float, default=20.0, help="of each attack, and of quiet before it and after")
    given = parser.parse_args()
    found = [line for name in given.attacks for line in siege(name, given.seconds)]
    for line in found:
        _say(f"NOT GOOD: {line}")
    return min(1, len(found))


def siege(name: str, seconds: float) -> Iterator[str]:
    """One attack on a server of its own; what does not hold."""
    with tempfile.TemporaryDirectory() as folder, _fortress(Path(folder), is_secure=name.endswith("tls")) as fortress:
        load = HonestLoad(
            fortress.url, {f"honest{n}": fortress.tokens[f"honest{n}"] for n in range(ROBOTS)}, verify=fortress.verify
        )
        load.live(1.0)  # warm
        before = load.live(seconds)
        token = fortress.tokens.get(ATTACKS[name][2], "none")
        port = urlsplit(fortress.url).port or 0
        arguments = [sys.executable, "-m", "tests.siege.attacks", name, str(port), token]
        attacker, watch = subprocess.Popen(arguments), MemoryWatch(fortress.process.pid)
        try:
            time.sleep(2.0)
            during = load.live(seconds)
            memory_mb = watch.end() / 1e6
            start_s = time.monotonic()
            fortress.process.send(signal.SIGTERM)
            code, complaints = fortress.process.end()
            stopped_s = time.monotonic() - start_s
        finally:
            watch.end()
            attacker.kill()
            attacker.wait()
    ended = f"SIGTERM {stopped_s:.1f} s, exit code {code}"
    _say(f"{name}: {ATTACKS[name][1]} connections; all processes {memory_mb:.0f} MB at most; {ended}")
    for kind in ("healthz", "push", "missing"):
        _say(f"  {kind:8} {_told(before, kind)} quiet, {_told(during, kind)} under attack")
    if during.failed or before.failed:
        _say(f"  failed: quiet {dict(before.failed)}, under attack {dict(during.failed)}")
    yield from _findings(name, before, during, stopped_s)
    if memory_mb > memory_shares().limit_bytes / 1e6:
        yield f"{name}: {memory_mb:.0f} MB, the limit is {memory_shares().limit_bytes / 1e6:.0f} MB"
    if code or "Traceback" in complaints:
        yield f"{name}: exit code {code}, {complaints[-1000:]}"


def _findings(name: str, before: Waits, during: Waits, stopped_s: float) -> Iterator[str]:
    if not during.seconds["healthz"] or max(during.seconds["healthz"]) > HEALTHY_S or "healthz" in str(during.failed):
        yield f"{name}: /healthz did not answer within {HEALTHY_S:g} s each time"
    if stopped_s > STOPPED_S:
        yield f"{name}: SIGTERM took {stopped_s:.1f} s"
    for kind in ("push", "missing"):
        for share in (0.5, 0.99):
            quiet_s, attacked_s = before.at(kind, share), during.at(kind, share)
            if not attacked_s <= SLOWER * quiet_s:
                yield f"{name}: {kind} p{100 * share:g} {1e3 * attacked_s:.0f} ms, quiet {1e3 * quiet_s:.0f} ms"
    if during.failed:
        yield f"{name}: {dict(during.failed)}"


def _told(waits: Waits, kind: str) -> str:
    p50, p99, most = (1e3 * waits.at(kind, share) for share in (0.5, 0.99, 1.0))
    return f"p50 {p50:.0f} p99 {p99:.0f} max {most:.0f} ms ({len(waits.seconds[kind])})"


@contextmanager
def _fortress(folder: Path, *, is_secure: bool) -> Iterator[Fortress]:
    for name, secret in (("admin", ADMIN), ("enroller", ENROLLER)):
        (folder / name).write_text(secret)
        (folder / name).chmod(0o600)
    arguments = ["--admin-token-file", str(folder / "admin"), "--enrolment-token-file", str(folder / "enroller")]
    verify: str | bool = True
    if is_secure:
        verify = str(_certificate(folder))
        arguments += ["--tls-cert", verify, "--tls-key", str(folder / "key.pem")]
    process = Process(folder / "store", *arguments, under=("prlimit", f"--nofile={DESCRIPTORS}:{DESCRIPTORS}"))
    assert process.url is not None, "the server did not start"
    context = ssl.create_default_context(cafile=verify) if isinstance(verify, str) else True
    with httpx.Client(base_url=process.url, headers=bearer(ADMIN), timeout=60, verify=context) as http:
        body = CreateMap(geometry=SMALL).model_dump_json()
        http.put("/maps/lab", content=body, headers={"Content-Type": "application/json"}).raise_for_status()
        tokens = {
            name: http.put(f"/tokens/{name}", json={"role": "robot", "map": "lab", "robot": name}).json()["token"]
            for name in ("mole", *(f"honest{n}" for n in range(ROBOTS)))
        }
        tokens["robot"] = tokens["mole"]
        tokens["reader"] = http.put("/tokens/eyes", json={"role": "reader", "map": "lab"}).json()["token"]
    yield Fortress(process, process.url, tokens, verify)


def _certificate(folder: Path) -> Path:
    subject = ("-days", "2", "-subj", "/CN=cairn", "-addext", "subjectAltName=IP:127.0.0.1")
    curve = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes")
    files = ("-keyout", "key.pem", "-out", "cert.pem")
    subprocess.run(("openssl", "req", "-x509", *curve, *subject, *files), cwd=folder, check=True, capture_output=True)
    return folder / "cert.pem"


def _say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
