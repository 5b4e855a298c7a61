"""An archived map that is brought back is the map: cells, log and seals, byte for byte; its robots go on."""

from collections.abc import Iterator
from pathlib import Path

import apsw
import pytest
from tests.fixtures.server.archived_map import COMMITS, answers, filled, tables_of
from tests.fixtures.server.live import Live
from tests.fixtures.server.pushes import pushed

from cairn_map.errors import BadInputError, ConflictError, DamagedDataError, NotFoundError
from cairn_server.operations.serve import main
from cairn_server.store.sqlite.store import FILE_NAME


@pytest.fixture
def live(tmp_path: Path) -> Iterator[Live]:
    with Live(tmp_path / "data") as server:
        yield server


def test_archive_then_unarchive_is_the_identity(live: Live, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data, file = tmp_path / "data", tmp_path / "lab.cairn"
    other, row = filled(live), filled(live)
    told, others = answers(live, row), answers(live, other)
    before = tables_of(data / FILE_NAME, row.name)
    assert main(["archive", row.name, str(file), "--data", str(data)]) == 0
    assert f"map {row.name}, 0." in capsys.readouterr().out
    assert file.stat().st_mode & 0o777 == 0o600
    live.http.delete(f"/maps/{row.name}", params={"confirm": row.name}).raise_for_status()
    live.__exit__(None, None, None)
    assert main(["unarchive", str(file), "--data", str(data)]) == 0
    assert f"map {row.name} is in {data}: 1 maps" in capsys.readouterr().out
    assert tables_of(data / FILE_NAME, row.name) == before
    with Live(data) as again:
        assert (answers(again, row), answers(again, other)) == (told, others)
        made = again.service.store.map(row.name)
        assert made.seal_key == row.seal_key and made.number != row.number
        assert again.push(made, pushed(9, 2)).status_code == 201
        assert again.push(made, COMMITS[5]).status_code == 200
        assert again.retract(made, COMMITS[2]).status_code == 201
        again.folded(made)


def test_an_archive_comes_back_in_another_server_s_store(live: Live, tmp_path: Path) -> None:
    row = filled(live)
    told = answers(live, row)
    main(["archive", row.name, str(tmp_path / "a"), "--data", str(tmp_path / "data")])
    with Live(tmp_path / "other") as other:
        for _ in range(2):
            filled(other)
        numbers = {each.number for each in other.service.store.maps()}
        other.http.delete("/maps/map0", params={"confirm": "map0"}).raise_for_status()
    main(["unarchive", str(tmp_path / "a"), "--data", str(tmp_path / "other")])
    with Live(tmp_path / "other") as other:
        assert answers(other, row) == told
        assert other.service.store.map(row.name).number not in numbers


def test_an_archive_is_refused_where_it_does_not_fit(live: Live, tmp_path: Path) -> None:
    data, file = tmp_path / "data", tmp_path / "lab.cairn"
    row = filled(live)
    with pytest.raises(NotFoundError, match="has no map 'nowhere'"):
        main(["archive", "nowhere", str(file), "--data", str(data)])
    assert not file.exists()
    (tmp_path / "notes").write_text("mine")
    with pytest.raises(BadInputError, match="no archive"):
        main(["archive", row.name, str(tmp_path / "notes"), "--data", str(data)])
    main(["archive", row.name, str(file), "--data", str(data)])
    with pytest.raises(ConflictError) as refusal:
        main(["unarchive", str(file), "--data", str(data)])
    assert refusal.value.kind == "store_in_use"
    live.__exit__(None, None, None)
    before = (data / FILE_NAME).read_bytes()
    with pytest.raises(ConflictError) as refusal:
        main(["unarchive", str(file), "--data", str(data)])
    assert refusal.value.kind == "map_exists"
    main(["backup", str(tmp_path / "whole"), "--data", str(data)])
    connection = apsw.Connection(str(tmp_path / "whole"))
    connection.execute("UPDATE cell SET body = zeroblob(length(body))")
    connection.close()
    with pytest.raises(DamagedDataError):
        main(["unarchive", str(tmp_path / "whole"), "--data", str(data)])
    assert (data / FILE_NAME).read_bytes() == before
    assert {path.name for path in data.iterdir()} <= {FILE_NAME, "cairn.lock", "ended-tokens", "last-backup"}


def test_an_archive_has_no_tokens_in_it(live: Live, tmp_path: Path) -> None:
    row = filled(live)
    main(["archive", row.name, str(tmp_path / "a"), "--data", str(tmp_path / "data")])
    connection = apsw.Connection(str(tmp_path / "a"))
    assert connection.execute("SELECT count(*) FROM token").get == 0
    assert connection.execute("SELECT count(*) FROM gone_token").get == 0
    connection.close()
