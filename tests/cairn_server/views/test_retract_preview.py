"""`POST .../main/changes`: the voxels that a retract would change are exactly those that it changes."""

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from tests.fixtures.map.classed import classed_evidence
from tests.fixtures.map.made import SMALL, random_evidence
from tests.fixtures.server.epoch_pushes import pushed_in
from tests.fixtures.server.live import Live
from tests.fixtures.server.pushes import KEYS, MOLE, WREN, pushed

from cairn_map.codec.view_code import decode_view
from cairn_map.commits.commit import Commit
from cairn_map.epochs.epoch import Epoch
from cairn_map.epochs.history_cell import HistoryCell
from cairn_map.epochs.layer import MapLayer
from cairn_map.errors import BadInputError, UnreachableError
from cairn_map.evidence.channels import HEIGHT_OFFSET, classes_channel
from cairn_map.evidence.grid import CellKey, Geometry, centres_of_voxels
from cairn_map.kernels.morton_kernels import deinterleave
from cairn_map.wire.change_messages import CellVoxels, RetractChanges
from cairn_map.wire.messages import Retract
from cairn_server.access.cancellation import CANCELLATION, Cancellation, StopTime
from cairn_server.cell_room import DECODING
from cairn_server.folding.cells_at_rest import sum_of_contributions
from cairn_server.store.store import Snapshot
from cairn_server.store.store_rows import Contribution, MapRow
from cairn_server.views import map_changes, retract_preview

LEVEL = Geometry(voxel_edge_um=50_000, height_step_um=12_000, depth=3, channels=(HEIGHT_OFFSET,))
"""A grid whose bins are no whole number of steps of heights."""
CLASSES = Geometry(voxel_edge_um=50_000, depth=3, channels=(classes_channel(("wall", "table", "chair")),))
Looks = dict[tuple[float, ...], tuple[int, ...]]
"""By the centre of a voxel what a view shows of it: probability, temperature or height (-1: none), colour."""


def previewed(live: Live, row: MapRow, *commits: Commit) -> RetractChanges:
    answer = live.http.post(f"/maps/{row.name}/main/changes", json={"commits": [str(each.id) for each in commits]})
    assert answer.status_code == 200, answer.text
    return RetractChanges.model_validate(answer.json())


def looks(live: Live, row: MapRow) -> Looks:
    """All that is shown of a map, voxel by voxel."""
    found: Looks = {}
    for entry in live.http.get(f"/maps/{row.name}/main/cells").json()["cells"]:
        cell = ",".join(map(str, entry["cell"]))
        data = live.http.get(f"/maps/{row.name}/main/cells/{cell}.view", params={"depth": row.geometry.depth}).content
        view = decode_view(data).view
        voxels = deinterleave(view.nodes.astype(np.uint64)) + np.array(entry["cell"]) * row.geometry.side
        values = np.full((len(view.nodes), 5), -1)
        values[:, 0] = view.chances
        values[view.scalar_rows, 1] = view.scalar_steps[:, 0]
        values[view.coloured, 2:] = view.rgb
        places = np.round(centres_of_voxels(voxels, row.geometry), 6).tolist()
        found |= {tuple(place): tuple(each) for place, each in zip(places, values.tolist(), strict=True)}
    return found


def places(cells: list[CellVoxels]) -> set[tuple[float, ...]]:
    return {tuple(place) for cell in cells for place in cell.centres_m}


@pytest.mark.parametrize("epochs", [False, True])
def test_a_preview_names_exactly_what_the_retract_changes(live: Live, epochs: bool) -> None:
    if epochs:
        row = live.new_map(SMALL, epoch_s=120)
        layer = MapLayer(geometry=SMALL, epoch_s=120)
        commits = [pushed_in(Epoch(3 * n), n, seed, layer=layer) for n, seed in enumerate((0, 1, 3, 6))]
    else:
        row = live.new_map(SMALL)
        commits = [pushed(n, seed) for n, seed in enumerate((0, 1, 3, 6))]
    changes_are_named(live, row, commits)


@pytest.mark.parametrize("grid", ["level", "level with epochs", "classes"])
def test_a_preview_of_a_level_or_of_classes_names_what_the_page_shows_otherwise(live: Live, grid: str) -> None:
    geometry, has_epochs = CLASSES if grid == "classes" else LEVEL, grid == "level with epochs"
    row = live.new_map(geometry, epoch_s=120 if has_epochs else None)
    layer, commits = MapLayer(geometry=geometry, epoch_s=120), list[Commit]()
    for n in range(4):
        if geometry.is_flat:
            cells = {KEYS[0]: random_evidence(n, geometry, voxels=900, air=3)}
        else:
            # What is taken out has votes alone: probabilities stay, and a class may lead by more or less than before.
            seen = classed_evidence(n, geometry, voxels=300)
            has_votes = np.isin(np.arange(len(seen)), seen.sampled)
            cells = {KEYS[0]: replace(seen, counts=0 * seen.counts).where(has_votes) if n % 2 else seen}
        if has_epochs:
            commits.append(pushed_in(Epoch(3 * n), n, n, layer=layer, cells=cells))
        else:
            commits.append(pushed(n, n, geometry=geometry, cells=cells, sensors=("a", "b", "c")))
    changes = changes_are_named(live, row, commits)
    assert changes.otherwise and not changes.warmer and not changes.colder


def changes_are_named(live: Live, row: MapRow, commits: list[Commit]) -> RetractChanges:
    """Push commits and retract two of them; the preview, which named what looked otherwise after it."""
    for commit in commits:
        assert live.push(row, commit).status_code == 201
    live.folded(row)
    before = looks(live, row)
    named = previewed(live, row, commits[1], commits[3])
    assert looks(live, row) == before, "nothing is taken out by looking"
    live.http.post(f"/maps/{row.name}/retracts", json={"commits": [str(commits[n].id) for n in (1, 3)]})
    live.folded(row)
    after = looks(live, row)
    heat = {place: (before[place][1], after[place][1]) for place in before.keys() & after.keys()}
    both = {place for place, (now, then) in heat.items() if min(now, then) >= 0}
    assert places(named.gone) == before.keys() - after.keys()
    assert places(named.appeared) == after.keys() - before.keys()
    if row.geometry.is_flat:
        both = set()  # heights
    assert places(named.warmer) == {place for place in both if heat[place][1] > heat[place][0]}
    assert places(named.colder) == {place for place in both if heat[place][1] < heat[place][0]}
    differing = {place for place in heat if before[place] != after[place]}
    assert places(named.otherwise) == differing - places(named.warmer) - places(named.colder)
    assert named.commits == 2
    assert sum(named.counts.model_dump().values()) == len(differing) + len(before.keys() ^ after.keys()) > 0
    again = previewed(live, row, commits[1])
    assert (again.commits, sum(again.counts.model_dump().values())) == (0, 0), "it is out already"
    return named


def test_previews_are_refused_as_retracts_are(live: Live) -> None:
    row = live.new_map(SMALL)
    assert live.push(row, pushed(0, 0)).status_code == 201
    live.folded(row)
    kinds = {}
    for name, body in (("none", {"robot": "nightjar"}), ("retract", {"commits": ["operator.0123456789abcdef.0"]})):
        kinds[name] = live.http.post(f"/maps/{row.name}/main/changes", json=body).json()["kind"]
    assert kinds == {"none": "nothing_to_retract", "retract": "not_retractable"}
    unknown = live.http.post(f"/maps/{row.name}/main/changes", json={"commits": [f"{WREN}.7"]})
    assert unknown.json()["commits"] == 0
    assert f"{MOLE}.0" in live.http.get(f"/maps/{row.name}/log").text


@pytest.mark.parametrize("mark", ["time", "cancelled"])
def test_a_preview_ends_between_two_contributions_of_one_cell(
    live: Live, monkeypatch: pytest.MonkeyPatch, mark: str
) -> None:
    row = live.new_map(SMALL)
    commits = [pushed(n, 0, cells={KEYS[0]: random_evidence(n, SMALL, voxels=6, air=1)}) for n in range(4)]
    for commit in commits:
        assert live.push(row, commit).status_code == 201
    live.folded(row)
    cancellation, decoded = Cancellation(StopTime()), list[Contribution]()

    def first(snapshot: Snapshot, key: CellKey, entries: Iterable[Contribution], layer: MapLayer) -> HistoryCell:
        def counted() -> Iterator[Contribution]:
            for entry in entries:
                decoded.append(entry)
                yield entry
                if mark == "cancelled":
                    cancellation.cancel()
                else:
                    monkeypatch.setattr(retract_preview, "time", SimpleNamespace(monotonic=lambda: math.inf))

        return sum_of_contributions(snapshot, key, counted(), layer)

    monkeypatch.setattr(retract_preview, "sum_of_contributions", first)
    token = CANCELLATION.set(cancellation)
    try:
        with pytest.raises(BadInputError) as ended:
            live.service.views.retracts.asked(row, Retract(commits=[str(each.id) for each in commits]))
    finally:
        CANCELLATION.reset(token)
    assert ended.value.kind == {"time": "too_costly", "cancelled": "cut_off"}[mark]
    assert len(decoded) == 1


def test_a_preview_has_the_bounds_of_a_search_for_changes(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    row = live.new_map(SMALL)
    commits = [pushed(n, 0) for n in range(3)]
    for commit in commits:
        assert live.push(row, commit).status_code == 201
    live.folded(row)
    views, request = live.service.views, Retract(commits=[str(each.id) for each in commits])
    with monkeypatch.context() as bounded:
        bounded.setattr(retract_preview, "PAST_ENTRIES_MAX", 2)
        with pytest.raises(BadInputError, match="more than 2 of the commits") as costly:
            views.retracts.asked(row, request)
        assert views.retracts.asked(row, Retract(commits=request.commits[:2])).commits == 2
    with monkeypatch.context() as bounded:
        bounded.setattr(DECODING, "limit_bytes", 1)
        with pytest.raises(BadInputError, match="too large to be compared"):
            views.retracts.asked(row, request)
    monkeypatch.setattr(map_changes, "WAIT_S", 0.0)
    with views.changes.turn(), views.changes.turn(), pytest.raises(UnreachableError) as busy:
        views.retracts.asked(row, request)
    assert (costly.value.kind, busy.value.kind) == ("too_costly", "busy")
