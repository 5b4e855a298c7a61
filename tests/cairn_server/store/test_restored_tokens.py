"""Tokens after a restore: what was ended since the backup stays ended, or nothing counts before an admin says so."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import apsw
import pytest
from tests.fixtures.commands import cairn
from tests.fixtures.map.made import SMALL
from tests.fixtures.server.access import ADMIN, ENROLLER, bearer, robot_token
from tests.fixtures.server.answers import kind_of
from tests.fixtures.server.live import Live
from tests.fixtures.server.old_stores import unpacked
from tests.fixtures.server.pushes import MOLE, WREN, pushed

from cairn_client.http.api import MapApi
from cairn_map.errors import UnreachableError
from cairn_map.wire.access_messages import CreateToken
from cairn_map.wire.messages import CreateMap
from cairn_server.store.sqlite import ended_tokens
from cairn_server.store.sqlite.ended_tokens import LIST_NAME, ended_since, list_id
from cairn_server.store.sqlite.store import FILE_NAME, SqliteStore

ENDED = {"chief": "revoked", "eye": "rotated", "mole": "deregistered", "wren": "registered again"}


def url_of(live: Live) -> str:
    return f"http://127.0.0.1:{live.port}"


@contextmanager
def serving(folder: Path) -> Iterator[tuple[Live, MapApi]]:
    with Live(folder, admin_token=ADMIN, enrolment_token=ENROLLER) as live, MapApi(url_of(live), token=ADMIN) as admin:
        yield live, admin


def worth(live: Live, secrets: dict[str, str]) -> dict[str, str]:
    """State of each token: `good`, or the kind of refusal."""
    paths = {name: "/maps/lab" if name in ("mole", "wren", "newt") else "/maps" for name in secrets}
    answers = {name: live.http.get(paths[name], headers=bearer(secret)) for name, secret in secrets.items()}
    return {name: "good" if answer.status_code == 200 else kind_of(answer) for name, answer in answers.items()}


@pytest.fixture
def history(tmp_path: Path) -> dict[str, str]:
    """Secrets of a server in `old`, of which `backup` was made before some of them ended."""
    with serving(tmp_path / "old") as (live, admin):
        admin.create_map("lab", CreateMap(geometry=SMALL))
        row = live.service.store.map("lab")
        secrets = {
            name: admin.create_token(name, CreateToken(role=role)).token
            for name, role in (("chief", "admin"), ("eye", "reader"), ("desk", "operator"))
        }
        secrets |= {name: robot_token(live, row, name) for name in ("mole", "wren", "newt")}
        live.push(row, pushed(0, 0, MOLE), headers=bearer(ADMIN))
        assert set(worth(live, secrets).values()) == {"good"}
        cairn("serve", "backup", "--data", tmp_path / "old", tmp_path / "backup", folder=tmp_path)
        admin.revoke_token("chief")
        admin.rotate_token("eye")
        admin.deregister("lab", "mole")
        robot_token(live, row, "wren")
        live.push(row, pushed(0, 0, WREN), headers=bearer(ADMIN))
        assert worth(live, secrets) == dict.fromkeys(secrets, "good") | dict.fromkeys(ENDED, "bad_token")
    return secrets


def restored(tmp_path: Path, *options: object) -> str:
    return cairn("serve", "restore", tmp_path / "backup", "--data", tmp_path / "new", *options, folder=tmp_path)


def test_with_the_old_folder_what_ended_stays_so_and_the_losses_are_counted(
    history: dict[str, str], tmp_path: Path
) -> None:
    said = restored(tmp_path, "--old", tmp_path / "old")
    assert "2 count at once, 4 ended since the backup" in said
    assert f"not in the backup: 1 commits, 8 audit lines, 2 tokens of {tmp_path / 'old'}" in said
    with serving(tmp_path / "new") as (live, admin):
        assert worth(live, history) == dict.fromkeys(history, "good") | dict.fromkeys(ENDED, "bad_token")
        admin.revoke_token("desk")
    # The list goes on in the new folder, also for the same backup once more.
    (tmp_path / "again").mkdir()
    (tmp_path / "again" / LIST_NAME).write_bytes((tmp_path / "new" / LIST_NAME).read_bytes())
    said = cairn("serve", "restore", "backup", "--data", "again", folder=tmp_path)
    assert "1 count at once, 5 ended since the backup" in said
    assert "--old DIR would count them" in said
    with serving(tmp_path / "again") as (live, _):
        assert worth(live, history) == dict.fromkeys(history, "bad_token") | {"newt": "good"}


def test_on_a_new_machine_no_token_counts_before_an_admin_says_so(
    history: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    said = restored(tmp_path)
    assert "ALL 6 ARE OFF" in said
    assert "not in the backup: commits, audit lines and tokens that came after" in said
    monkeypatch.setenv("CAIRN_TOKEN", ADMIN)
    with serving(tmp_path / "new") as (live, admin):
        assert worth(live, history) == dict.fromkeys(history, "unconfirmed_token")
        assert kind_of(live.http.post("/tokens/desk/confirm", headers=bearer(history["chief"]))) == "unconfirmed_token"
        assert cairn("token", "list", url_of(live), folder=tmp_path).count("OFF: confirm it") == 6
        assert "1 tokens count again: desk" in cairn("token", "confirm", url_of(live), "desk", folder=tmp_path)
        assert worth(live, history) == dict.fromkeys(history, "unconfirmed_token") | {"desk": "good"}
        eye = admin.rotate_token("eye").token
        assert worth(live, {"eye": eye}) == {"eye": "good"}
        assert [line.what for line in live.service.store.audit_log.page(after=0, limit=99)][-2:] == [
            "confirm_token",
            "rotate_token",
        ]
        cairn("token", "confirm", url_of(live), "--all", folder=tmp_path)
        assert set(worth(live, history).values()) - {"bad_token"} == {"good"}


def test_a_list_that_began_after_the_backup_proves_nothing(history: dict[str, str], tmp_path: Path) -> None:
    (tmp_path / "old" / LIST_NAME).unlink()
    SqliteStore(tmp_path / "old").close()  # begins another list
    assert "ALL 6 ARE OFF" in restored(tmp_path, "--old", tmp_path / "old")
    with serving(tmp_path / "new") as (live, _):
        assert worth(live, history) == dict.fromkeys(history, "unconfirmed_token")


def test_a_backup_of_an_older_version_has_no_list(tmp_path: Path) -> None:
    (tmp_path / "old").mkdir()
    unpacked("v1.sqlite.zst", tmp_path / "old").rename(tmp_path / "backup")
    assert "ALL 1 ARE OFF" in restored(tmp_path, "--old", tmp_path / "old")


def test_what_cannot_be_written_down_does_not_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with serving(tmp_path) as (live, admin):
        secret = admin.create_token("eye", CreateToken(role="reader")).token
        before = (tmp_path / LIST_NAME).read_bytes()

        def full(*_: object) -> None:
            raise OSError(28, "No space left on device")

        with monkeypatch.context() as patch:
            patch.setattr(ended_tokens, "_append", full)
            with pytest.raises(UnreachableError) as refused:
                admin.revoke_token("eye")
        assert refused.value.kind == "disk_full"
        assert worth(live, {"eye": secret}) == {"eye": "good"}
        assert (tmp_path / LIST_NAME).read_bytes() == before
        admin.revoke_token("eye")
        assert worth(live, {"eye": secret}) == {"eye": "bad_token"}


def test_a_list_that_a_power_cut_left_short_is_read_to_its_last_whole_line(tmp_path: Path) -> None:
    with serving(tmp_path) as (live, admin):
        secrets = [admin.create_token(name, CreateToken(role="reader")).token for name in ("eye", "ear")]
        admin.revoke_token("eye")
        path = tmp_path / LIST_NAME
        path.write_bytes(path.read_bytes() + b"0123abc")
        admin.revoke_token("ear")
        found = ended_since(path, tmp_path / FILE_NAME)
        assert found is not None
        assert len(found) == len(secrets)
        connection = apsw.Connection(str(tmp_path / FILE_NAME))
        assert list_id(path) == connection.execute("SELECT id FROM ended_list").get
        connection.close()
        assert (path.stat().st_mode & 0o777) == 0o600
        assert live.http.get("/healthz").status_code == 200
