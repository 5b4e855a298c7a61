"""Inbox of a live source: bounded by its bytes, newest wins, and each message is taken or counted."""

import threading

import numpy as np

from cairn_client.live.inbox import SMALL_BYTES, Inbox
from cairn_fusion.ros.bag import BagMessage

IMAGE = bytes(SMALL_BYTES + 1)
LIMIT = 10 * len(IMAGE)


def test_all_is_taken_in_its_order() -> None:
    inbox = Inbox()
    for n in range(5):
        inbox.put(BagMessage(f"/{n}", n, b"x"))
    assert [message.log_ns for message in inbox.take(within_s=0.0)] == [0, 1, 2, 3, 4]
    assert inbox.take(within_s=0.0) == []


def test_the_oldest_images_go_and_transforms_stay_and_all_are_counted() -> None:
    inbox, rng = Inbox(bytes_max=LIMIT), np.random.default_rng(1)
    sent = [BagMessage("/tf" if rng.random() < 0.5 else "/image", n, b"") for n in range(200)]
    sent = [message._replace(data=IMAGE if message.topic == "/image" else b"tf") for message in sent]
    for message in sent:
        inbox.put(message)
    taken = inbox.take(within_s=0.0)
    assert sum(len(message.data) for message in taken) <= LIMIT
    assert [m for m in taken if m.topic == "/tf"] == [m for m in sent if m.topic == "/tf"]
    images, all_images = ([m for m in some if m.topic == "/image"] for some in (taken, sent))
    assert images == all_images[-len(images) :]
    assert inbox.dropped == {"/image": len(all_images) - len(images)}


def test_small_messages_alone_are_bounded_too_and_the_newest_stays() -> None:
    inbox = Inbox(bytes_max=1000)
    for n in range(3000):
        inbox.put(BagMessage("/tf", n, b"t"))
    taken = inbox.take(within_s=0.0)
    assert len(taken) + inbox.dropped["/tf"] == 3000 and len(taken) <= 1000
    assert taken[-1].log_ns == 2999
    inbox.put(BagMessage("/image", 0, bytes(5000)))
    assert len(inbox.take(within_s=0.0)) == 1


def test_messages_without_bytes_are_bounded_by_what_they_take_themselves() -> None:
    inbox = Inbox(bytes_max=100_000)
    for n in range(10_000):
        inbox.put(BagMessage("/tf", n, b""))
    taken = inbox.take(within_s=0.0)
    assert 0 < len(taken) <= 500 and len(taken) + inbox.dropped["/tf"] == 10_000


def test_a_reader_that_waits_wakes_with_the_message_or_the_end() -> None:
    inbox, found = Inbox(), list[list[BagMessage]]()

    def read() -> None:
        for _ in range(2):
            found.append(inbox.take(within_s=30.0))

    reader = threading.Thread(target=read)
    reader.start()
    inbox.put(BagMessage("/a", 1, b""))
    while not found:
        reader.join(0.001)
    inbox.close()
    reader.join()
    assert [len(messages) for messages in found] == [1, 0]
