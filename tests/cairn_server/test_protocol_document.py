"""PROTOCOL.md says what the code does: its routes, its kinds, its limits."""

import ast
import re

import pytest
from tests.fixtures.server.live import Live
from tests.fixtures.server.protocol_document import DOCUMENT, ROOT, ROUTE, documented_kinds, routes_of

from cairn_map.commits.attachment import ATTACHMENT_BYTES_MAX
from cairn_map.commits.commit import COMMIT_BYTES_MAX, RETRACTS_MAX
from cairn_map.commits.mark import MARKS_MAX
from cairn_map.files import octomap
from cairn_map.queries import hot_spots
from cairn_map.render import render_request
from cairn_map.wire import live_events
from cairn_map.wire.messages import CURSORS_MAX, JSON_FIELDS_MAX, JSON_VALUES_MAX
from cairn_server.http.middleware import body_limit
from cairn_server.http.routes import cell as cell_routes
from cairn_server.http.routes import problems
from cairn_server.live import hub as live
from cairn_server.live import robot_reports
from cairn_server.memory_shares import CHECK_MAX_BYTES
from cairn_server.settings import Quotas, Settings
from cairn_server.store import numbering, shares, store_rows
from cairn_server.store.attachments import attachments
from cairn_server.sync import cell_changes, missing, uploads
from cairn_server.sync.checks import check_pool, commit_checks
from cairn_server.views import (
    export_tickets,
    hot_spot_search,
    hottest_search,
    map_changes,
    map_exports,
    map_views,
    readings,
)

KIND = re.compile(r"[a-z]+(_[a-z]+)*")
RAISERS = ("_problem", "send_problem", "__init__")


def kinds_in(folder: str) -> set[str]:
    """Text constants that errors and problems are made with."""
    found: set[str] = set()
    for path in (ROOT / folder).rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call):
                name = getattr(node.func, "id", getattr(node.func, "attr", ""))
                if name.endswith("Error") or name in RAISERS:
                    texts = [a.value for a in node.args if isinstance(a, ast.Constant) and isinstance(a.value, str)]
                    found |= {text for text in texts if KIND.fullmatch(text)}
    return found


def test_the_route_table_is_that_of_the_app(live: Live) -> None:
    assert {(found[1], found[2]) for found in ROUTE.finditer(DOCUMENT)} == routes_of(live)


def test_every_kind_in_the_code_is_in_the_document_and_no_other() -> None:
    code = kinds_in("server/cairn_server") | kinds_in("fusion/cairn_map")
    code |= {*problems.KIND_OF_STATUS.values(), "http"}
    assert code == documented_kinds()


@pytest.mark.parametrize(
    "kind",
    ["no_token", "bad_ticket", "too_many_tickets", "too_large", "other_log", "quota", "damaged_store", "disk_full"],
)
def test_the_statuses_in_the_document_are_those_of_the_code(kind: str) -> None:
    row = next(line for line in DOCUMENT.splitlines() if line.startswith("| `") and f"`{kind}`" in line)
    assert int(row.split("|")[2]) == problems.STATUS_OF_KIND[kind]


@pytest.mark.parametrize(
    ("row", "number"),
    [
        ("body of a push, or of a cell", COMMIT_BYTES_MAX),
        ("body of `missing`", body_limit.MISSING_BYTES_MAX),
        ("body of a status", body_limit.STATUS_BYTES_MAX),
        ("body of a view", body_limit.VIEW_BYTES_MAX),
        ("any other body", body_limit.JSON_BYTES_MAX),
        ("views of one robot in a second", robot_reports.VIEWS_PER_S),
        ("bytes that are here of bodies that come in parts, of all robots", uploads.STAGED_BYTES_MAX),
        ("cells listed in `missing`", CURSORS_MAX),
        ("commits named in one retract request", RETRACTS_MAX),
        ("reply to `missing`", missing.REPLY_BYTES_MAX),
        ("raw bytes of all streams of a commit", commit_checks.ALLOWANCE_BYTES),
        ("modelled numbers of a commit (masks; leaves once for each modelled group)", commit_checks.ALLOWANCE_NUMBERS),
        ("both, of any commit", commit_checks.RAW_BYTES_MAX),
        ("ordinary commits checked at once", commit_checks.THREADS_MAX),
        ("dear commits that wait for a worker", check_pool.WAITING_MAX),
        ("live streams of one token", live.LISTENERS_OF_TOKEN_MAX),
        ("live streams", live.LISTENERS_MAX),
        ("pixels of a rendered picture", render_request.REQUEST_PIXELS_MAX),
        ("range of a rendered picture", render_request.RANGE_MAX_M),
        ("cells in its sight", map_views.CELLS_IN_VIEW_MAX),
        ("voxels of the cells that it takes", map_views.VOXELS_READ_MAX),
        ("making it", map_views.RENDER_S),
        ("pictures made at once", map_views.RENDERS_AT_ONCE),
        ("known voxels of the cells that an export looks at", map_exports.VOXELS_EXPORTED_MAX),
        ("cells at the border of a box whose unknown space is filled", octomap.BORDER_CELLS_MAX),
        ("counting an export's points", map_exports.COUNT_S),
        ("exports counted at once", map_exports.COUNTS_AT_ONCE),
        ("voxels in an answer about changes", map_changes.CHANGED_MAX),
        (
            "memory for the cells of a search for the hottest voxels",
            hottest_search.CELLS_BYTES,
        ),
        ("looking for the hottest voxels", hottest_search.SEARCH_S),
        ("looking for hot spots", hot_spot_search.SEARCH_S),
        ("warm voxels at borders of cells, in a search for hot spots", hot_spots.BORDER_MAX),
        ("searches for changes at once", map_changes.SEARCHES_AT_ONCE),
        ("commits of a cell without epochs that are added up for its past", readings.PAST_ENTRIES_MAX),
        ("tickets for exports of one token", export_tickets.TICKETS_OF_TOKEN_MAX),
        ("tickets for exports", export_tickets.TICKETS_MAX),
        ("until a ticket ends", export_tickets.TICKET_S),
        ("header `Cairn-Coverage`", cell_routes.COVERAGE_BYTES_MAX),
        ("cells in one live event", live_events.CELLS_MAX),
        ("marks in one live event", live_events.MARKS_MAX),
        ("marks of one commit", MARKS_MAX),
        ("marks of one robot on a map that are not taken out", shares.MARKS_OF_ROBOT_MAX),
        ("one attachment of a mark", ATTACHMENT_BYTES_MAX),
        ("attachments of one robot's marks on a map", attachments.OF_ROBOT_BYTES_MAX),
        ("values in one JSON text", JSON_VALUES_MAX),
        ("problem's `detail`", problems.DETAIL_CHARACTERS_MAX),
        ("until a request's head is whole", Settings().head_s),
        ("until a body is whole, or an answer taken", Settings().body_grace_s),
        ("connections served at once", Settings().limit_concurrency),
        ("commits a minute", Quotas().commits_per_minute),
        ("bytes a day", Quotas().bytes_per_day),
        ("cells a day, of all commits together", Quotas().cells_per_day),
        ("bricks (8^3 voxels) a day that commits touch beyond one for each of their bytes", Quotas().bricks_per_day),
        ("longest edge of the box of a robot's cells in a map, this commit's included", Quotas().map_extent_m),
        ("robots with commits, those closed not counted", shares.ROBOTS_MAX),
        ("`incarnations`", shares.INCARNATIONS_MAX),
        ("`intervals` of the numbers of all its incarnations", shares.INTERVALS_OF_ROBOT_MAX),
        ("`sums`: per region of 4^3 cells, hits and misses", shares.limits_of("mole", 3)[0]),
        ("`sums`: per region of 4^3 cells, every other plane", shares.limits_of("mole", 3)[2]),
        ("audit log", store_rows.AUDIT_ROWS_MAX),
    ],
)
def test_the_limits_in_the_document_are_those_of_the_code(row: str, number: float) -> None:
    cell = next(line for line in DOCUMENT.splitlines() if line.startswith(f"| {row} |")).split("|")[2]
    written = re.search(r"\d+\^\d+|\d[\d ]*\d|\d", cell)
    assert written
    assert eval(written[0].replace("^", "**").replace(" ", "")) == number


def test_the_bounds_of_cost_in_the_document_are_those_of_the_code() -> None:
    defaults = Settings()
    assert f"and {commit_checks.PER_BYTE} for each byte of its body" in DOCUMENT
    assert f"| {defaults.check_cpu_s:.0f} s; a share of `memory_bytes`, 3 * 2^29 bytes at most (settings) |" in DOCUMENT
    assert commit_checks.NUMBERS_MAX == 2**25
    assert "; 2^25 modelled numbers |" in DOCUMENT
    assert JSON_FIELDS_MAX == 2**18
    assert "; 2^18 fields |" in DOCUMENT
    assert CHECK_MAX_BYTES == 3 * 2**29


def test_the_limits_of_push_in_the_document_are_those_of_the_code() -> None:
    policy = DOCUMENT.split("### 4.1 Push")[1].split("**Folding**")[0]
    for text in (
        f"n at most {numbering.AHEAD_MAX:_} above".replace("_", " "),
        f"lists {missing.RETRACTS_MAX} of them",
        f"those of {missing.PENDING_AUTHORS_MAX} authors",
        f"| {shares.INTERVALS_OF_RESERVE_MAX:_} |".replace("_", " "),
        f"| {shares.AUTHORS_OF_RESERVE_MAX:_} |".replace("_", " "),
        f"| {shares.limits_of(shares.RESERVE, 3)[0]:_} |".replace("_", " "),
        f"| 2^{int(shares.limits_of(shares.RESERVE, 3)[2]).bit_length() - 1} |",
        f"at most {cell_changes.DELTA_ENTRIES_MAX} entries",
    ):
        assert text in policy + DOCUMENT, text
