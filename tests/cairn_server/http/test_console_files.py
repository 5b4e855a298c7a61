"""The page as the server hands it out; what it does in a browser is in tests/console."""

import gzip
from pathlib import Path

import pytest
from tests.fixtures.server.live import Live

from cairn_map.errors import NotFoundError
from cairn_server.http.routes.console import ConsoleFiles


@pytest.fixture
def files(tmp_path: Path) -> ConsoleFiles:
    (tmp_path / "assets").mkdir()
    (tmp_path / "index.html").write_text("<!doctype html><title>built</title>")
    (tmp_path / "assets" / "index-abc.js").write_text("export {};" * 100)
    (tmp_path / "assets" / "secret.txt").write_text("not of the page")
    return ConsoleFiles(tmp_path)


def test_a_server_without_a_built_page_says_how_to_build_it(tmp_path: Path) -> None:
    page = ConsoleFiles(tmp_path).page
    assert b"make console" in page.plain
    assert page.media_type.startswith("text/html")


def test_files_come_plain_and_gzipped_by_their_very_names(files: ConsoleFiles) -> None:
    script = files.asset("index-abc.js")
    assert gzip.decompress(script.gzipped) == script.plain
    assert script.media_type.startswith("text/javascript")
    for name in ("../index.html", "secret.txt", "index-abd.js", ""):
        with pytest.raises(NotFoundError):
            files.asset(name)


def test_the_page_is_served_under_a_strict_policy_and_asked_for_again(live: Live) -> None:
    answer = live.http.get("/")
    policy = answer.headers["Content-Security-Policy"]
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    assert answer.headers["Cache-Control"] == "no-cache"
    assert live.http.get("/", headers={"If-None-Match": answer.headers["ETag"]}).status_code == 304
    assert live.http.get("/", headers={"Accept-Encoding": "identity"}).text == answer.text


def test_an_asset_stays_with_browsers_for_ever(live: Live, files: ConsoleFiles) -> None:
    live.app.state.console_files = files
    answer = live.http.get("/assets/index-abc.js")
    assert "immutable" in answer.headers["Cache-Control"]
    assert answer.headers["Content-Encoding"] == "gzip"
    assert live.http.get("/assets/index-old.js").json()["kind"] == "no_route"
