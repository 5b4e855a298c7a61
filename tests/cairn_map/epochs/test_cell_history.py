"""Rows of a cell: they add in any order, and the sum of all is that of a map without epochs."""

import itertools
import random

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.fixtures.map.histories import EPOCHS, LAYER, SIGNED_HISTORIES, as_naive, random_history
from tests.fixtures.map.made import KEY, MIDDLE, SMALL, as_dict, random_evidence
from tests.naive import history as naive_history

from cairn_map.epochs.cell_history import NOTHING, CellHistory, cell_history, history_fingerprint, merged, unmerged
from cairn_map.epochs.epoch import BASE, EPOCH_MAX, Epoch
from cairn_map.errors import BadInputError
from cairn_map.evidence.brick_cell import sum_evidence
from cairn_map.evidence.evidence import empty_evidence
from cairn_map.evidence.fingerprint import ZERO, fingerprint

SEEDS = st.integers(0, 10**6)
COMMITS = st.lists(st.tuples(EPOCHS, st.integers(0, 40)), min_size=1, max_size=8)


@given(COMMITS, st.randoms(use_true_random=False), st.data())
def test_any_order_of_commits_and_retracts_gives_equal_rows(
    commits: list[tuple[Epoch, int]], order: random.Random, data: st.DataObject
) -> None:
    steps = [(cell_history({epoch: random_evidence(seed, SMALL, voxels=6, air=1)}), 1) for epoch, seed in commits]
    steps += [(step, -1) for step, _ in data.draw(st.lists(st.sampled_from(steps), unique_by=id))]
    naive = naive_history.history_of([(e, r, sign) for step, sign in steps for e, r in as_naive(step).items()])
    order.shuffle(steps)
    whole = NOTHING
    for step, sign in steps:
        whole = merged([whole, step], SMALL) if sign > 0 else unmerged(whole, step, SMALL)
    assert as_naive(whole) == naive
    assert as_dict(whole.total(SMALL)) == naive_history.total(naive)


@given(SEEDS, SEEDS)
def test_what_is_taken_out_again_was_never_there(a: int, b: int) -> None:
    x, y = random_history(a), random_history(b)
    assert unmerged(merged([x, y], SMALL), y, SMALL) == x
    assert unmerged(x, x, SMALL) == NOTHING


@given(SEEDS, SEEDS)
def test_totals_are_the_sums_of_a_map_without_epochs(a: int, b: int) -> None:
    x, y = random_history(a, MIDDLE), random_history(b, MIDDLE)
    rows = itertools.chain(x.rows.values(), y.rows.values())
    assert merged([x, y], MIDDLE).total(MIDDLE) == sum_evidence(rows, MIDDLE)


@given(SIGNED_HISTORIES)
def test_the_fingerprint_is_what_its_twin_says(history: CellHistory) -> None:
    found = history_fingerprint(history, KEY, layer_word=LAYER.word)
    assert (found.first, found.second) == naive_history.fingerprint(as_naive(history), KEY, LAYER.word)


@given(SEEDS, SEEDS)
def test_fingerprints_add_as_histories_do(a: int, b: int) -> None:
    x, y = random_history(a), random_history(b)
    sums = [history_fingerprint(history, KEY, layer_word=7) for history in (x, y, merged([x, y], SMALL))]
    assert sums[0] + sums[1] == sums[2]


def test_evidence_in_another_epoch_or_layer_has_another_fingerprint() -> None:
    row = random_evidence(1, SMALL)
    histories = [cell_history({Epoch(epoch): row}) for epoch in (BASE, -1, 0, 1, EPOCH_MAX)]
    found = {history_fingerprint(history, KEY, layer_word=word) for history in histories for word in (0, 1)}
    assert len(found) == 2 * len(histories)


def test_a_base_alone_has_the_fingerprint_of_version_1() -> None:
    row = random_evidence(1, SMALL)
    assert history_fingerprint(cell_history({BASE: row}), KEY, layer_word=0) == fingerprint(row, KEY)
    assert history_fingerprint(NOTHING, KEY, layer_word=5) == ZERO


def test_rows_up_to_an_epoch_are_those_captured_then() -> None:
    history = cell_history({Epoch(n): random_evidence(n, SMALL) for n in (2, 5, 9)})
    assert [*history.until(Epoch(5))] == [2, 5]
    assert history.until(BASE) == NOTHING


def test_rows_without_evidence_are_not_there() -> None:
    assert cell_history({Epoch(3): empty_evidence(SMALL)}) == NOTHING
    with pytest.raises(BadInputError, match="must rise in epoch and hold evidence"):
        CellHistory({Epoch(3): empty_evidence(SMALL)})


def test_epochs_beyond_the_range_are_refused() -> None:
    with pytest.raises(BadInputError, match="an epoch is at most"):
        cell_history({Epoch(1 << 62): random_evidence(1, SMALL)})
