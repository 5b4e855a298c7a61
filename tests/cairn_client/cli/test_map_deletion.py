"""`cairn map delete` asks before it deletes, and `rename` says why there is no such thing."""

import io
import sys

import pytest
from tests.fixtures.server.live import Live, live
from tests.fixtures.server.pushes import pushed

from cairn_client.main import main
from cairn_server.store.store_rows import MapRow

__all__ = ["live"]


class Terminal(io.StringIO):
    """Standard input at which a person types."""

    def isatty(self) -> bool:
        return True


def url_of(live: Live, row: MapRow) -> str:
    live.push(row, pushed(0, 0))
    live.folded(row)
    return f"http://127.0.0.1:{live.port}/maps/{row.name}"


def is_there(live: Live, row: MapRow) -> bool:
    return row.name in {each.name for each in live.service.store.maps()}


def test_the_map_s_name_is_asked_for_and_nothing_else_deletes_it(
    live: Live, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    row = live.new_map()
    url = url_of(live, row)
    for typed in ("", "y\n", "yes\n", "another\n"):
        monkeypatch.setattr(sys, "stdin", Terminal(typed))
        assert main(["map", "delete", url]) == 1
        assert "nothing was deleted [not_confirmed]" in capsys.readouterr().err
    monkeypatch.setattr(sys, "stdin", io.StringIO(f"{row.name}\n"))
    assert main(["map", "delete", url]) == 1
    assert "--yes deletes it without a question" in capsys.readouterr().err
    assert is_there(live, row)
    monkeypatch.setattr(sys, "stdin", Terminal(f"{row.name}\n"))
    assert main(["map", "delete", url]) == 0
    said = capsys.readouterr().out
    assert f"map {row.name}: 1 commits of 0 robots" in said and f"map {row.name} is deleted" in said
    assert not is_there(live, row)
    assert main(["map", "delete", url]) == 3
    assert "was deleted on 20" in capsys.readouterr().err


def test_a_script_deletes_without_a_question(live: Live, capsys: pytest.CaptureFixture[str]) -> None:
    row = live.new_map()
    assert main(["map", "delete", url_of(live, row), "--yes"]) == 0
    assert not is_there(live, row)


def test_rename_says_why_not_and_what_else(live: Live, capsys: pytest.CaptureFixture[str]) -> None:
    row = live.new_map()
    url = url_of(live, row)
    for arguments in ([url], [url, "other"]):
        assert main(["map", "rename", *arguments]) == 1
        said = capsys.readouterr().err
        assert "signed their commits for that name" in said and "cairn map create" in said and "map_is_fixed" in said


def test_info_says_what_a_map_takes_besides_its_cells(live: Live, capsys: pytest.CaptureFixture[str]) -> None:
    row = live.new_map()
    assert main(["map", "info", url_of(live, row)]) == 0
    assert "of evidence that is kept, and about 500 B of log (1 entries)" in capsys.readouterr().out
    assert main(["map", "info", url_of(live, row), "--json"]) == 0
    assert '"sizes": {"present_bytes":' in capsys.readouterr().out
