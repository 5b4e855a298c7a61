"""Wrong tokens: who tries them is in the log and in the audit log, and a flood of them fills neither."""

import logging
from pathlib import Path

import pytest
from tests.fixtures.server.live import Live
from tests.memory_store.store import MemoryStore

from cairn_server.access import wrong_tokens
from cairn_server.access.wrong_tokens import LINES_OF_ADDRESS, LINES_PER_HOUR, WrongTokens

ADMIN = {"Authorization": "Bearer " + "a" * 20}
WRONG = {"Authorization": "Bearer wrong-secret-1234567"}


def test_every_wrong_token_is_in_a_line_or_in_the_count_of_the_next_one() -> None:
    now_s = 0.0
    turns = WrongTokens(MemoryStore(), steady_s=lambda: now_s)
    told = [turns.turn(f"198.51.100.{n % 250}") for n in range(1000)]
    assert [left_out for left_out in told if left_out is not None] == [0] * LINES_PER_HOUR
    now_s = 3600.0
    assert turns.turn("192.0.2.7") == 1000 - LINES_PER_HOUR
    assert turns.turn("192.0.2.7") == 0


def test_one_address_leaves_room_for_the_others() -> None:
    turns = WrongTokens(MemoryStore(), steady_s=lambda: 0.0)
    assert [turns.turn("192.0.2.7") for _ in range(LINES_OF_ADDRESS + 2)] == [*[0] * LINES_OF_ADDRESS, None, None]
    assert turns.turn("192.0.2.8") == 2


def test_a_flood_is_remembered_in_little_memory() -> None:
    turns = WrongTokens(MemoryStore(), steady_s=lambda: 0.0)
    for n in range(10_000):
        turns.turn(str(n))
    assert len(turns._lines) <= LINES_PER_HOUR


def test_a_wrong_token_is_told_with_its_address_and_without_itself(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.WARNING, logger="cairn_server")
    with Live(tmp_path, admin_token="a" * 20) as live:
        assert live.http.get("/maps", headers=WRONG).status_code == 401
        assert live.http.post("/maps/lab/retracts", headers=WRONG, content=b"{}").status_code == 401
        assert live.http.get("/maps").status_code == 401  # no token at all is a page that is opened
        assert live.http.get("/healthz").status_code == 200
        live.service.store.audit_log.add("test", "mark", "the lines before are written")
        lines = live.http.get("/audit", params={"what": "bad_token"}, headers=ADMIN).json()
        chained = live.service.store.audit_log.page(limit=9)
    assert [(line["who"], line["client"], line["detail"]) for line in lines] == [
        ("server", "127.0.0.1", "wrong token from 127.0.0.1")
    ] * 2
    assert chained[1].is_next_after(chained[0])
    assert "wrong-secret" not in caplog.text and caplog.text.count("wrong token from 127.0.0.1") == 2


def test_many_wrong_tokens_are_few_lines(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(wrong_tokens, "LINES_OF_ADDRESS", 2)
    with Live(tmp_path, admin_token="a" * 20) as live:
        for _ in range(9):
            live.http.get("/maps", headers=WRONG)
        live.service.store.audit_log.add("test", "mark", "the lines before are written")
        lines = live.http.get("/audit", params={"what": "bad_token"}, headers=ADMIN).json()
    assert len(lines) == 2
