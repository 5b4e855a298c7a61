"""`cairn serve --upstream` as processes: found through the entry points, with tokens, through cuts."""

import os
import signal
import tomllib
from pathlib import Path

import pytest
from tests.fixtures.client.joined import Server, mapped
from tests.fixtures.client.made import MAP
from tests.fixtures.server.live import Process, until

from cairn_client.http.api import MapApi
from cairn_map.errors import BadInputError
from cairn_server.operations.serve_options import serve_parser, settings_of
from cairn_server.settings import Settings

ROOT = Path(__file__).parents[3]


@pytest.fixture
def entry_points(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of this tree, whatever is installed."""
    folder = tmp_path / "installed" / "cairn_of_tree-1.dist-info"
    folder.mkdir(parents=True)
    groups = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["entry-points"]
    lines = [f"[{group}]\n" + "\n".join(f"{k} = {v}" for k, v in points.items()) for group, points in groups.items()]
    (folder / "entry_points.txt").write_text("\n".join(lines))
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: cairn-of-tree\nVersion: 1\n")
    monkeypatch.setenv("PYTHONPATH", f"{folder.parent}{os.pathsep}{os.environ.get('PYTHONPATH', '')}")


@pytest.mark.processes
@pytest.mark.usefixtures("entry_points")
def test_a_field_server_joins_a_base_by_its_options_and_goes_on_without_it(tmp_path: Path) -> None:
    with Server(tmp_path / "base") as base:
        base.create_map()
        mapped(base, tmp_path / "robot", "robot", 1, 2)
        base.folded(base.row)
        secret = tmp_path / "secret"
        secret.write_text(base.token("field", role="relay"))
        secret.chmod(0o600)
        options = ("--upstream", base.url, "--upstream-token-file", str(secret), "--trust-server", base.key)
        field = Process(tmp_path / "field", *options)
        assert field.url is not None
        with MapApi(field.url) as api:
            until(lambda: [info.name for info in api.maps()] == [MAP], "the map is made")
            until(lambda: len(api.log(MAP)) == 2, "what the base has came")
            base.retract(*base.ids())
            until(lambda: len(api.log(MAP)) == 5, "the base's retract came")
            assert {entry.via for entry in api.log(MAP)} == {"upstream"}
    with MapApi(field.url) as api:
        assert api.map_info(MAP).cells == 0
        assert len(api.maps()) == 1
    field.send(signal.SIGTERM)
    code, said = field.end()
    assert code == 0
    assert "no link to upstream" in said or said == ""


def test_the_options_become_settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CAIRN_UPSTREAM_TOKEN", "t" * 20)
    keys = ["0" * 64, "f" * 64]
    trust = [part for key in keys for part in ("--trust-server", key)]
    found: Settings = settings_of(
        serve_parser("").parse_args(["--data", str(tmp_path), "--upstream", "http://base:8750", *trust])
    )
    assert (found.upstream, found.upstream_token) == ("http://base:8750", "t" * 20)
    assert found.trusted_servers.split() == keys


def test_a_key_that_is_none_is_refused_by_its_option() -> None:
    with pytest.raises(BadInputError, match="--trust-server"):
        settings_of(serve_parser("").parse_args(["--trust-server", "abc"]))
