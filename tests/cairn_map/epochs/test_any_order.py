"""A thousand orders of the same commits, retracts and amends: equal bytes, and at each step the totals of one sum."""

import random

import pytest
from tests.fixtures.map.histories import LAYER, as_naive
from tests.fixtures.map.made import KEY, SMALL, as_dict, random_evidence
from tests.naive import history as naive_history

from cairn_map.codec.history_code import decode_history
from cairn_map.codec.layer_code import WrittenCell, row_coding, write_cell
from cairn_map.epochs.cell_history import cell_history, history_fingerprint, row_fingerprint
from cairn_map.epochs.epoch import BASE, EPOCH_MAX, Epoch
from cairn_map.epochs.history_cell import HistoryCell
from cairn_map.epochs.present import present
from cairn_map.evidence.brick_cell import BrickCell
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.fingerprint import ZERO, Fingerprint, fingerprint
from cairn_map.evidence.inverse_sensor_model import SensorModel

ORDERS_OF_A_SEED = 100
Part = tuple[Epoch, Evidence, int]
Event = tuple[Part, ...]
"""One commit that adds, takes out (a retract), or does both (an amend), by its parts: epoch, evidence, sign."""


def commits_and_their_ends(seed: int) -> list[Event]:
    """Eight commits of mixed epochs, a retract of one and amends of two, one of them into another epoch."""
    rng = random.Random(seed)
    epochs = [BASE, BASE, *(Epoch(rng.choice((-3, 0, 1, 7, EPOCH_MAX))) for _ in range(6))]
    commits = [(epoch, random_evidence(100 * seed + n, SMALL, voxels=6, air=1), 1) for n, epoch in enumerate(epochs)]
    ends = [(epoch, evidence, -1) for epoch, evidence, _ in rng.sample(commits, 3)]
    better = random_evidence(100 * seed + 50, SMALL, voxels=6, air=1)
    retract, *amends = ends
    return [
        *((commit,) for commit in commits),
        (retract,),
        (amends[0], (amends[0][0], better, 1)),
        (amends[1], (Epoch(2), better, 1)),
    ]


def fold_into(cell: HistoryCell, event: Event) -> None:
    for epoch, evidence, sign in event:
        (cell.merge if sign > 0 else cell.unmerge)(epoch, evidence)


def sum_into(total: BrickCell, event: Event) -> None:
    for _, evidence, sign in event:
        (total.merge if sign > 0 else total.unmerge)(evidence)


def print_of(event: Event) -> Fingerprint:
    found = ZERO
    for epoch, evidence, sign in event:
        own = row_fingerprint(evidence, epoch, KEY, layer_word=LAYER.word)
        found = found + own if sign > 0 else found - own
    return found


@pytest.mark.parametrize("seed", range(10))
def test_any_order_of_commits_retracts_and_amends_gives_equal_bytes(seed: int) -> None:
    events = commits_and_their_ends(seed)
    # The twin adds what FORMAT.md 16 says in the order in which it was written down.
    parts = [part for event in events for part in event]
    naive = naive_history.history_of([(None if e == BASE else int(e), as_dict(row), sign) for e, row, sign in parts])
    order, written = random.Random(seed), set[WrittenCell]()
    for _ in range(ORDERS_OF_A_SEED):
        order.shuffle(events)
        cell, one_sum = HistoryCell(KEY, LAYER, row_coding(LAYER)), BrickCell(SMALL)
        for event in events:
            fold_into(cell, event)
            sum_into(one_sum, event)
            # T5 holds at every step, also while a retract has come before its commit.
            assert cell.history().total(SMALL) == one_sum.packed()
        written.add(write_cell(cell))
    (found,) = written
    header, decoded = naive_history.decode_history(found.data)
    assert decoded == naive == as_naive(decode_history(found.data).history)
    assert header["digest"] == found.digest
    assert (found.fingerprint.first, found.fingerprint.second) == naive_history.fingerprint(naive, KEY, LAYER.word)


def test_fingerprints_of_rows_and_of_totals_add_as_commits_do() -> None:
    for events in (commits_and_their_ends(3), commits_and_their_ends(4)[::-1]):
        cell, of_rows, of_total = HistoryCell(KEY, LAYER, row_coding(LAYER)), ZERO, ZERO
        for event in events:
            fold_into(cell, event)
            of_rows += print_of(event)
            for _, evidence, sign in event:
                own = fingerprint(evidence, KEY)
                of_total = of_total + own if sign > 0 else of_total - own
            history = cell.history()
            assert history_fingerprint(history, KEY, layer_word=LAYER.word) == of_rows
            assert fingerprint(history.total(SMALL), KEY) == of_total


def test_ten_thousand_epochs_elsewhere_in_a_cell_unlearn_nothing() -> None:
    model = SensorModel()
    room = {Epoch(n): random_evidence(n, SMALL, voxels=60, air=0) for n in range(3)}
    before = present(cell_history(room), SMALL, model)
    seen = set(before.voxels.tolist())
    others = [random_evidence(n, SMALL, voxels=3, air=0) for n in range(100, 140)]
    others = [evidence for evidence in others if not seen & set(evidence.voxels.tolist())]
    assert len(others) > 5
    later = {Epoch(10 + n): others[n % len(others)] for n in range(10_000)}
    after = present(cell_history({**room, **later}), SMALL, model)
    mine = [n for n, voxel in enumerate(after.voxels.tolist()) if voxel in seen]
    assert len(mine) < len(after)
    assert after.log_odds[mine].tolist() == before.log_odds.tolist()
    assert after.counts[mine].tolist() == before.counts.tolist()
    assert after.newest[mine].tolist() == before.newest.tolist()
