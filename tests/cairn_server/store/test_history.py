"""Chains of the log in one snapshot: each is read once, and those of the head and of the empty log never."""

from cairn_map.commits.cursor import CHAIN_BYTES, Cursor, first_chain
from cairn_server.store.history import ReadChains

LOG, LAYER = bytes(range(16)), bytes(32)
CHAINS = {seq: bytes([seq]) * CHAIN_BYTES for seq in range(1, 9)}


def test_the_chain_at_an_entry_is_read_once_however_many_cells_ask_for_it() -> None:
    chains, read = ReadChains(Cursor(LOG, 8, CHAINS[8]), LAYER), []

    def chain_at(seq: int) -> bytes | None:
        def look_up() -> bytes | None:
            read.append(seq)
            return CHAINS.get(seq)

        return chains.get(seq, look_up)

    asked = [3, 5, 3, 8, 0, 5, 3]
    known = CHAINS | {0: first_chain(LOG, LAYER)}
    assert [chain_at(seq) for seq in asked] == [known[seq] for seq in asked]
    assert read == [3, 5]
    assert chain_at(9) is None
