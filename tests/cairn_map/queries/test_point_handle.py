"""Handles on a snapshot for compiled code: they answer as the snapshot does, and refuse once they are closed."""

import ctypes
import gc
import math
import re
import runpy
import shutil
import subprocess
import sys
import threading
import weakref
from pathlib import Path
from typing import Any

import numba as nb
import numpy as np
import numpy.typing as npt
import pytest
from tests.fixtures.map.made import GEOMETRIES, PLAIN, SMALL, random_evidence
from tests.fixtures.map.worlds import map_of, random_map, random_points, snapshot_with
from tests.fixtures.pages import DOCS

import cairn
from cairn_map.errors import BadInputError
from cairn_map.evidence.evidence_map import EvidenceMap
from cairn_map.evidence.grid import CELL_LIMIT, Geometry, cell_key, level_geometry
from cairn_map.queries.layers.layered_snapshot import LayeredSnapshot
from cairn_map.queries.map_snapshot import MapSnapshot, snapshot_of
from cairn_map.queries.native import handle_kernels as kernels
from cairn_map.queries.native import point_handle
from cairn_map.queries.native.point_handle import PointHandle
from cairn_map.queries.occupancy_states import State

Points = npt.NDArray[np.float64]
FLAT = level_geometry(voxel_edge_m=0.2).model_copy(update={"depth": 3})
NOWHERE = (math.nan, math.inf, -math.inf, 1e300, CELL_LIMIT * PLAIN.cell_edge_m)
needs_cc = pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler (cc)")


def one_by_one(handle: PointHandle, points: Points) -> list[int]:
    return [handle.state(handle.map, *point) for point in points.tolist()]


def at_once(handle: PointHandle, points: Points, *, number: int | None = None) -> tuple[int, list[int]]:
    """Call `cairn_states`: its return value, and the states that it wrote, 77 where it wrote none."""
    function = ctypes.CFUNCTYPE(ctypes.c_int32, ctypes.c_uint64, ctypes.c_void_p, ctypes.c_int64, ctypes.c_void_p)(
        handle.states_address
    )
    points, states = np.ascontiguousarray(points), np.full(len(points), 77, np.int8)
    code = function(handle.map if number is None else number, points.ctypes.data, len(points), states.ctypes.data)
    return code, states.tolist()


@pytest.fixture
def snapshot() -> MapSnapshot:
    return snapshot_of(random_map(1, PLAIN))


@pytest.fixture
def fresh_slots(monkeypatch: pytest.MonkeyPatch) -> None:
    """One slot at a time, which the next handle takes again."""
    monkeypatch.setattr(point_handle, "_SLOTS", point_handle._Slots())
    monkeypatch.setattr(point_handle, "SLOTS_MADE", 1)


@pytest.mark.parametrize("geometry", [*GEOMETRIES, FLAT])
def test_each_point_has_the_state_that_the_snapshot_gives_it(geometry: Geometry) -> None:
    whole = random_map(3, geometry)
    snapshot, points = snapshot_of(whole), random_points(5, whole, 600)
    # In cells that are as flat as their voxels, a third of all heights on a border.
    points[:, 2] *= geometry.voxel_height_m / geometry.voxel_edge_m
    points[1::3, 2] = np.rint(points[1::3, 2] / geometry.voxel_height_m) * geometry.voxel_height_m
    # Borders of cells and bricks, the last points below them, and places without any cell.
    edge_m = geometry.voxel_edge_m
    borders = np.array([[x, y, z] for x in (-8, 0, 8, 16) for y in (-8, 0) for z in (0, 8)]) * edge_m
    points = np.concatenate([points, borders, np.nextafter(borders, -np.inf), borders - 1e-10, borders + 1e5])
    states = snapshot.state_at(points).tolist()
    assert {*states} == {0, 1, 2}
    with PointHandle(snapshot) as handle:
        assert one_by_one(handle, points) == states
        assert at_once(handle, points) == (0, states)


def test_of_layers_the_finest_that_knows_a_point_answers() -> None:
    def layer(geometry: Geometry, seed: int) -> MapSnapshot:
        whole = EvidenceMap(geometry)
        for n, cell in enumerate([(0, 0, 0), (-1, 0, 0), (0, -1, -1)]):
            whole.merge({cell_key(cell): random_evidence(seed + n, geometry, voxels=150)})
        return snapshot_of(whole)

    fine = Geometry(voxel_edge_um=20_000, depth=3, channels=())
    layers = LayeredSnapshot({"wide": layer(FLAT, 1), "evidence": layer(SMALL, 5), "fine": layer(fine, 9)})
    rng = np.random.default_rng(2)
    points = np.concatenate([rng.uniform(-reach, reach, (300, 3)) for reach in (0.16, 0.4, 1.6, 4.0)])
    assert {*layers.names_at(points)} == {"fine", "evidence", "wide", None}
    with PointHandle(layers) as handle:
        assert one_by_one(handle, points) == layers.state_at(points).tolist()
        # Farther than the finest layer reaches, though not the others.
        far = [[0.0, 0.0, CELL_LIMIT * fine.cell_edge_m]]
        with pytest.raises(BadInputError):
            layers.state_at(far)
        assert one_by_one(handle, np.array(far)) == [-1]


@pytest.mark.parametrize("bad", NOWHERE)
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_points_that_the_snapshot_refuses_are_outside(snapshot: MapSnapshot, bad: float, axis: int) -> None:
    points = np.full((3, 3), 0.01)
    known = int(snapshot.state_at(points[:1])[0])
    points[1, axis] = bad
    with PointHandle(snapshot) as handle:
        assert one_by_one(handle, points) == [known, -1, known]
        assert at_once(handle, points) == (-1, [known, -1, known])


def test_an_empty_map_knows_nothing() -> None:
    with PointHandle(snapshot_of(EvidenceMap(PLAIN))) as handle:
        assert handle.state(handle.map, 0.0, 0.0, 0.0) == State.UNKNOWN
        assert at_once(handle, np.empty((0, 3))) == (0, [])


@pytest.mark.usefixtures("fresh_slots")
def test_a_closed_handle_answers_no_more_and_nor_for_a_later_one() -> None:
    occupied, free = (snapshot_with(PLAIN, {(0, 0, 0): counts}) for counts in ((1, 0), (0, 1)))
    with PointHandle(occupied) as first:
        state, number = first.state, first.map
        assert state(number, 0.0, 0.0, 0.0) == State.OCCUPIED
    first.close()
    assert repr(first) == "PointHandle(closed)"
    assert state(number, 0.0, 0.0, 0.0) == kernels.CLOSED
    assert state(0, 0.0, 0.0, 0.0) == kernels.CLOSED
    with pytest.raises(BadInputError) as refused:
        _ = first.map
    assert refused.value.kind == "handle_closed"
    with PointHandle(free) as later:
        # In the same slot, of the next generation.
        assert later.map == number + 1
        assert state(later.map, 0.0, 0.0, 0.0) == State.FREE
        assert state(number, 0.0, 0.0, 0.0) == kernels.CLOSED
        assert at_once(later, np.zeros((2, 3)), number=number) == (kernels.CLOSED, [77, 77])


@pytest.mark.usefixtures("fresh_slots")
def test_a_slot_is_left_after_its_last_generation(monkeypatch: pytest.MonkeyPatch, snapshot: MapSnapshot) -> None:
    monkeypatch.setattr(point_handle, "GENERATIONS", 3)
    numbers = []
    for _ in range(3):
        with PointHandle(snapshot) as handle:
            numbers.append(handle.map)
    assert numbers[1] == numbers[0] + 1
    assert numbers[2] >> kernels.GENERATION_BITS != numbers[0] >> kernels.GENERATION_BITS


@pytest.mark.usefixtures("fresh_slots")
def test_garbage_may_be_collected_while_a_handle_is_opened(
    monkeypatch: pytest.MonkeyPatch, snapshot: MapSnapshot
) -> None:
    zeros = np.zeros

    def collecting(*shape: Any) -> Any:
        if shape[0] == 2 * point_handle.SLOT_WORDS:
            gc.collect()
        return zeros(*shape)

    opened: list[int] = []

    def open_many() -> None:
        for _ in range(4):
            # A holder that refers to itself, so that only a collection finds it: one that begins as slots are made.
            holder: list[Any] = [PointHandle(snapshot)]
            holder.append(holder)
            opened.append(holder[0].map)
            del holder

    monkeypatch.setattr(np, "zeros", collecting)
    # A daemon: a thread that waits for itself never ends.
    opening = threading.Thread(target=open_many, daemon=True)
    opening.start()
    opening.join(30)
    assert len({*opened}) == 4


def test_a_handle_keeps_the_states_of_its_snapshot_until_it_is_closed_or_gone() -> None:
    whole = random_map(1, PLAIN)
    points = random_points(3, whole, 200)
    snapshot = snapshot_of(whole)
    states, words = snapshot.state_at(points).tolist(), weakref.ref(snapshot.frozen.grid.words)
    handle, other = PointHandle(snapshot), PointHandle(snapshot)
    state, number = other.state, other.map
    del snapshot
    whole.clear()
    assert one_by_one(handle, points) == states
    handle.close()
    assert words() is not None
    del other
    assert words() is None
    assert state(number, 0.0, 0.0, 0.0) == kernels.CLOSED


def calls_of(handle: PointHandle) -> ctypes.c_uint64:
    """Counter of the calls in progress."""
    address = handle.map >> kernels.GENERATION_BITS << kernels.SLOT_BITS
    return ctypes.c_uint64.from_address(address + 8 * kernels.CALLS)


def test_closing_waits_for_calls_in_progress() -> None:
    snapshot = snapshot_of(random_map(1, PLAIN))
    handle = PointHandle(snapshot)
    state, number, calls = handle.state, handle.map, calls_of(handle)
    words = weakref.ref(snapshot.frozen.grid.words)
    del snapshot
    calls.value = 1
    closing = threading.Thread(target=handle.close)
    closing.start()
    while state(number, 0.0, 0.0, 0.0) != kernels.CLOSED:
        pass
    # Later calls are refused; the arrays are there for the one that has begun.
    assert closing.is_alive()
    assert words() is not None
    calls.value -= 1
    closing.join()
    assert calls.value == 0
    assert words() is None


@pytest.mark.usefixtures("fresh_slots")
def test_a_forked_process_does_not_wait_for_calls_that_are_not_its_own(
    snapshot: MapSnapshot, monkeypatch: pytest.MonkeyPatch
) -> None:
    handle = PointHandle(snapshot)
    calls = calls_of(handle)
    calls.value = 1
    slot = handle.map >> kernels.GENERATION_BITS
    monkeypatch.setattr(point_handle.os, "getpid", lambda: -1)
    handle.close()
    # Handles of the forked process never take the slot, whose calls stay counted: they would not close.
    later = PointHandle(snapshot)
    calls.value = 0
    assert later.map >> kernels.GENERATION_BITS != slot
    later.close()


def test_calls_of_many_threads_are_answered_or_refused_while_handles_come_and_go() -> None:
    snapshots = [snapshot_with(PLAIN, {(0, 0, 0): counts}) for counts in ((1, 0), (0, 1))]
    points, wrong, over = np.zeros((1000, 3)), [], threading.Event()
    shared: list[tuple[int, int]] = [(0, 0)]

    def ask(states: PointHandle) -> None:
        while not over.is_set():
            number, right = shared[0]
            found = at_once(states, points, number=number)
            if found not in ((0, [right] * 1000), (kernels.CLOSED, [77] * 1000)):
                wrong.append(found)

    with PointHandle(snapshots[0]) as any_handle:
        threads = [threading.Thread(target=ask, args=(any_handle,)) for _ in range(2)]
        for thread in threads:
            thread.start()
        for n in range(200):
            with PointHandle(snapshots[n % 2]) as handle:
                shared[0] = handle.map, 2 - n % 2
                assert handle.state(handle.map, 0.0, 0.0, 0.0) == 2 - n % 2
        over.set()
        for thread in threads:
            thread.join()
    assert wrong == []


def test_functions_of_numba_call_it(snapshot: MapSnapshot) -> None:
    points = np.random.default_rng(1).uniform(-0.5, 0.5, (300, 3))
    with PointHandle(snapshot) as handle:
        state, number = handle.state, np.uint64(handle.map)

        @nb.njit
        def free(points: Points) -> int:
            return sum([state(number, p[0], p[1], p[2]) == 1 for p in points])

        assert free(points) == (snapshot.state_at(points) == State.FREE).sum() > 0


def test_the_header_says_what_the_library_does() -> None:
    text = PointHandle.HEADER.read_text()
    values = {name: int(value) for name, value in re.findall(r"CAIRN_(\w+) = (-?\d+)", text)}
    assert values == {state.name: state for state in State} | {"OUTSIDE": kernels.OUTSIDE, "CLOSED": kernels.CLOSED}
    assert f"#define CAIRN_POINTS_VERSION {PointHandle.VERSION} " in text


@needs_cc
@pytest.mark.processes
def test_the_planner_of_the_examples_finds_the_wall(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    library = tmp_path / "planner.so"
    include = f"-I{PointHandle.HEADER.parent}"
    strict = ["-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror"]
    source = str(DOCS / "examples" / "planner.c")
    subprocess.run(["cc", *strict, "-shared", "-fPIC", "-O2", include, source, "-o", str(library), "-lm"], check=True)
    # Free for a metre, then a wall; to the other side the unknown begins after 20 cm.
    room = {(x, 0, 0): (0, 1) for x in range(-4, 20)} | {(20, 0, 0): (1, 0)}
    snapshot = snapshot_of(map_of(PLAIN, room))
    monkeypatch.setattr(cairn, "open_map", lambda url: snapshot)
    for goal, said in (
        ("2", "free for 0.99 of 1.98 m"),
        ("0.5", "free for 0.48 of 0.48 m"),
        ("-1", "free for 0.22 of 1.02 m"),
    ):
        monkeypatch.setattr(sys, "argv", ["planner.py", "lab", str(library), "0.02", "0", "0", goal, "0", "0"])
        runpy.run_path(str(DOCS / "examples" / "planner.py"))
        assert capsys.readouterr().out == f"{said}\n"
    # The same header, in C++.
    if shutil.which("c++"):
        subprocess.run(["c++", "-fsyntax-only", "-Wall", "-Werror", "-x", "c++", include, source], check=True)
