"""HEAD: every route that answers GET answers it, with the same status and head, and no body."""

import httpx
import pytest
from tests.fixtures.server.live import Live
from tests.fixtures.server.protocol_document import ROUTES
from tests.fixtures.server.pushes import KEYS, MOLE, pushed

from cairn_map.evidence.grid import cell_of_key
from cairn_server.store.store_rows import MapRow

GETS = [path for method, path in ROUTES if method == "GET"]
OF_THE_MOMENT = {"date", "x-request-id", "content-length"}
"""Headers that differ from one answer to the next; the length of a figure's text among them."""


@pytest.fixture(scope="module")
def row(live: Live) -> MapRow:
    """A map with a robot, its commit and a cell."""
    made = live.new_map()
    live.http.post(f"/maps/{made.name}/branches", json={"robot": "mole", "incarnation": MOLE.incarnation})
    live.push(made, pushed(0, 0))
    live.folded(made)
    return made


def kept(answer: httpx.Response) -> dict[str, str]:
    return {name: value for name, value in answer.headers.items() if name not in OF_THE_MOMENT}


@pytest.mark.parametrize("path", GETS)
def test_every_route_that_answers_get_answers_head(live: Live, row: MapRow, path: str) -> None:
    place = {"name": row.name, "branch": "mole", "commit": str(pushed(0, 0).id), "cell": str(cell_of_key(KEYS[0]))}
    place |= {"voxel": "0,0,0", "file": "none.js", "token": "none", "sha": "0" * 64}
    url = path.format(**place)
    get, head = live.ask("GET", url), live.http.head(url)
    assert get.status_code == head.status_code != 405
    assert head.content == b""
    assert kept(head) == kept(get)


def test_a_head_is_followed_by_the_next_answer_on_the_same_connection(live: Live, row: MapRow) -> None:
    """A body that came after all would be taken for the next answer; and a stream without end must end."""
    with httpx.Client(base_url=live.http.base_url, timeout=60) as http:
        for path in ("/metrics", f"/maps/{row.name}/events", f"/maps/{row.name}/main/export", "/nothing", "/readyz"):
            http.head(path)
            assert http.get("/healthz").json() == {"status": "ok"}


def test_a_head_is_counted_as_one(live: Live) -> None:
    live.http.head("/healthz")
    line = 'cairn_http_requests_total{method="HEAD",route="/healthz",status="200"}'
    assert line in live.http.get("/metrics").text
