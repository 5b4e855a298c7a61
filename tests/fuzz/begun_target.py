"""A reply that is cut, and the one after it: `=== first` and `=== then`, as `begun_frames.py` puts them together."""

import random
from collections.abc import Callable
from contextlib import suppress

from tests.fuzz.sections import joined, sections_of
from tests.fuzz.wrapping_mutator import mutated_reply

from cairn_map.codec.cell_reading import CELL_BYTES_MAX
from cairn_map.errors import CairnError
from cairn_map.wire.frames import CellFrame, Frame, encode_frame, frames_of, start_of_reply
from cairn_map.wire.messages import MissingRequest
from cairn_map.wire.resumed_replies import Replies, without_begun

PIECE_BYTES = 97


def read_begun(data: bytes) -> None:
    """What was begun is kept, and a server that leaves it out of what it sends next gives the same frames."""
    sections = dict(sections_of(data))
    first, then = sections.get("first", b""), sections.get("then", b"")
    memory = Replies()
    with suppress(CairnError):
        _read(memory, first)
    _check(memory)
    honest = memory.reply_to(MissingRequest())
    try:
        whole = [frame for frame in frames_of(then) if not (isinstance(frame, CellFrame) and frame.continues)]
    except CairnError:
        whole = None
    if whole is not None:
        sent = without_begun(whole, honest.request.begun)
        came = honest.frames([start_of_reply() + b"".join(map(encode_frame, sent))])
        assert [encode_frame(frame) for frame in came] == [encode_frame(frame) for frame in whole]
        _check(memory)
    else:  # a hostile one
        _read(memory, then)


def mutated_begun(data: bytes, rng: random.Random, mutate: Callable[[bytes], bytes]) -> bytes:
    """One reply cut somewhere else, or changed inside."""
    sections = sections_of(data)
    if not sections or rng.random() < 0.05:
        return mutate(data)
    at = rng.randrange(len(sections))
    name, reply = sections[at]
    is_cut = rng.random() < 0.4
    sections[at] = name, reply[: rng.randrange(len(reply) + 1)] if is_cut else mutated_reply(reply, rng, mutate)
    return joined(sections)


def _read(memory: Replies, data: bytes) -> list[Frame]:
    reply = memory.reply_to(MissingRequest())
    frames = list(reply.frames(data[at : at + PIECE_BYTES] for at in range(0, len(data), PIECE_BYTES)))
    assert not any(isinstance(frame, CellFrame) and frame.continues for frame in frames)
    _check(memory)
    return frames


def _check(memory: Replies) -> None:
    if memory.begun is not None:
        assert len(memory.begun[1]) <= CELL_BYTES_MAX
    MissingRequest.model_validate(memory.reply_to(MissingRequest()).request.model_dump())
    list(memory.reply_to(MissingRequest()).again())
