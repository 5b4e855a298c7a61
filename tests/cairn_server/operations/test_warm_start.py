"""The server under a service user without a home, from code that is read-only: it starts, and is ready when it is warm.

The code is a copy that no user may write to, with the kernels of `cairn compile` or without any; where the tests run as
root, the server runs without a capability, so that modes count for it as for any user.
"""

import re
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.fixtures.server.live import until
from tests.fixtures.server.processes import all_folded, children_of, client, make_map
from tests.fixtures.server.pushes import KEYS, pushed
from tests.fixtures.server.service_user import ServiceUser, service_user

from cairn_map.evidence.grid import cell_of_key

pytestmark = pytest.mark.processes


@pytest.fixture
def service(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[ServiceUser]:
    with service_user(tmp_path, kernels=request.param) as found:
        yield found


@pytest.mark.parametrize("service", [False], indirect=True)
def test_it_lives_at_once_and_compiles_into_the_data_folder_before_it_is_ready(service: ServiceUser) -> None:
    process = service.start()
    with client(process) as http:
        assert http.get("/healthz").status_code == 200
        answer = http.get("/readyz")
        assert answer.status_code == 503
        assert re.fullmatch(r"compiling: \d+ of \d+, \d+ s", answer.json()["detail"])
        until(lambda: bool(list((service.data / "kernels").rglob("*.nbc"))), "a kernel is kept")
    children = children_of(process.pid)
    process.send(signal.SIGTERM)
    code, said = process.end()
    assert code == 0 and "compiling kernels, once for this version: 0 of " in said and "Traceback" not in said, said
    assert not [child for child in children if Path(f"/proc/{child}").exists()]


@pytest.mark.parametrize("service", [True], indirect=True)
def test_kernels_next_to_read_only_code_are_all_that_it_needs(service: ServiceUser) -> None:
    process = service.start()
    with client(process) as http:
        assert http.get("/readyz").status_code == 200
        make_map(http)
        commit = pushed(0, 0)
        http.put(f"/maps/lab/commits/{commit.id}", content=commit.data).raise_for_status()
        all_folded(http)
        main = "/maps/lab/main"
        for asked in (f"cells/{cell_of_key(KEYS[0])}.view", "render?x=0&y=0&z=0", "export?format=ply"):
            http.get(f"{main}/{asked}").raise_for_status()
    process.send(signal.SIGTERM)
    assert process.end() == (0, "")
    assert not (service.data / "kernels").exists(), "something was compiled"


@pytest.mark.parametrize("service", [False], indirect=True)
def test_without_a_folder_for_kernels_it_goes_on_and_says_so_in_one_line(service: ServiceUser) -> None:
    (service.data / "kernels").write_text("a file, where a folder should be")
    process = service.start()
    with client(process) as http:
        assert http.get("/readyz").status_code == 200
        make_map(http)
    process.send(signal.SIGTERM)
    code, said = process.end()
    assert code == 0
    (line,) = (
        line for line in said.splitlines() if "kernels" in line and "compiling kernels, only this once" not in line
    )
    assert line.endswith("no folder takes compiled kernels: each process compiles its own, and first requests wait")
