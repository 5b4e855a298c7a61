"""`cairn audit`: who did what, from where, newest first, by any admin under their own name."""

import json
import re
from pathlib import Path

import pytest
from tests.fixtures.commands import cairn
from tests.fixtures.server.live import Live

from cairn_client.cli.arguments import instant_of
from cairn_client.cli.audit import local_time
from cairn_map.errors import BadInputError

OWNER = "a" * 20


def test_each_admin_is_named_and_lines_are_found_by_who_what_map_and_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Live(tmp_path / "data", admin_token=OWNER) as live:
        url = f"http://127.0.0.1:{live.port}"
        ada, bob = (
            cairn("token", "create", url, name, "--role", "admin", "--token", OWNER, folder=tmp_path).strip()
            for name in ("ada", "bob")
        )
        cairn("map", "create", f"{url}/maps/lab", "--token", ada, folder=tmp_path)
        cairn("map", "create", f"{url}/maps/hall", "--token", bob, folder=tmp_path)
        eye = ("token", "create", url, "eye", "--role", "reader", "--map", "lab", "--token", bob)
        cairn(*eye, folder=tmp_path)
        cairn("map", "ls", url, "--token", "no-such-secret", folder=tmp_path, code=1)

        def shown(*options: str) -> list[list[str]]:
            head, *lines = cairn("audit", url, "--token", ada, *options, folder=tmp_path).splitlines()
            assert head.split() == ["time", "who", "what", "from", "about"]
            assert all(re.match(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d[+-]\d\d:\d\d  ", line) for line in lines)
            return [line.split(maxsplit=5)[2:] for line in lines]

        everything = shown("--since", "1h")
        assert [line[:3] for line in everything] == [
            ["server", "bad_token", "127.0.0.1"],
            ["bob", "create_token", "127.0.0.1"],
            ["bob", "create_map", "127.0.0.1"],
            ["ada", "create_map", "127.0.0.1"],
            ["admin", "create_token", "127.0.0.1"],
            ["admin", "create_token", "127.0.0.1"],
        ]
        assert shown("--who", "ada") == [["ada", "create_map", "127.0.0.1", "map lab: created"]]
        assert [line[:2] for line in shown("--map", "lab")] == [["bob", "create_token"], ["ada", "create_map"]]
        assert [line[1] for line in shown("--what", "create_map", "--who", "bob")] == ["create_map"]
        assert shown("--count", "2") == everything[:2]
        monkeypatch.setattr("cairn_client.cli.audit.PAGE", 4)
        assert shown() == everything
        late = cairn("audit", url, "--token", ada, "--until", "2001-01-01", folder=tmp_path)
        assert late.splitlines()[1] == "(nothing)"
        said = json.loads(cairn("audit", url, "--token", ada, "--who", "bob", "--json", folder=tmp_path))
        assert [(line["what"], line["client"]) for line in said] == [
            ("create_token", "127.0.0.1"),
            ("create_map", "127.0.0.1"),
        ]
        assert all(re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ", line["time_utc"]) for line in said)


def test_times_are_the_days_own_with_their_lead_over_utc(monkeypatch: pytest.MonkeyPatch) -> None:
    import time

    monkeypatch.setenv("TZ", "Europe/Prague")
    time.tzset()
    try:
        assert local_time(1_795_816_514.4) == "2026-11-27 22:55:14+01:00"
        assert local_time(1_782_597_314.0) == "2026-06-27 23:55:14+02:00"
    finally:
        monkeypatch.undo()
        time.tzset()


def test_an_age_is_a_time_as_long_ago() -> None:
    hour_ago = instant_of("1h")
    assert instant_of("60m") == pytest.approx(hour_ago, abs=60)
    assert instant_of("0.5d") == pytest.approx(hour_ago - 11 * 3600, abs=60)
    assert instant_of("2026-11-27T22:55:14+01:00") == 1_795_816_514
    with pytest.raises(BadInputError) as refused:
        instant_of("2 hours")
    assert refused.value.kind == "bad_time"
