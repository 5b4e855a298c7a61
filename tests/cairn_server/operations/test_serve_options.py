"""Flags, environment and settings file of `cairn serve`: who wins, and what a wrong one is answered."""

import tomllib
from pathlib import Path

import pytest

from cairn_map.errors import BadInputError
from cairn_server.operations.serve_options import MOVED, serve_parser, settings_of
from cairn_server.settings import Settings


def read(*argv: str) -> Settings:
    return settings_of(serve_parser("").parse_args(argv))


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "server.toml"


def test_without_anything_given_the_defaults_count() -> None:
    assert read().model_dump() == Settings().model_dump()


def test_a_flag_counts_before_the_environment_and_that_before_the_file(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file.write_text("keep_evidence_s = 1\nstable_after_s = 1\nbranch_expiry_s = 61\nquotas.bytes_per_day = 1\n")
    monkeypatch.setenv("CAIRN_KEEP_EVIDENCE_S", "2")
    monkeypatch.setenv("CAIRN_STABLE_AFTER_S", "2")
    monkeypatch.setenv("CAIRN_QUOTAS__CELLS_PER_DAY", "2")
    found = read("--settings", str(file), "--keep-evidence", "3")
    assert (found.keep_evidence_s, found.stable_after_s, found.branch_expiry_s) == (3, 2, 61)
    assert (found.quotas.bytes_per_day, found.quotas.cells_per_day, found.quotas.commits_per_minute) == (1, 2, 6000)


def test_a_quota_of_zero_is_no_bound(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file.write_text("quotas.bytes_per_day = 0\nquotas.map_extent_m = 0\n")
    monkeypatch.setenv("CAIRN_QUOTAS__CELLS_PER_DAY", "0")
    quotas = read("--settings", str(file)).quotas
    assert quotas.bytes_per_day is quotas.map_extent_m is quotas.cells_per_day is None


def test_variables_that_kubernetes_sets_are_not_read(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CAIRN_PORT", "tcp://10.0.0.1:8750")
    assert read().port == Settings().port


def test_an_empty_variable_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CAIRN_ENROLMENT_TOKEN", "")
    assert read().enrolment_token is None


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("fold_lag = 5", "server.toml: fold_lag: there is no such setting"),
        ("quotas.cells = 5", "server.toml: quotas.cells: there is no such setting"),
        ("head_s = 'soon'", "server.toml: head_s: "),
        ("head_s = ", "server.toml is no TOML"),
        (None, "cannot read .*server.toml"),
    ],
)
def test_a_wrong_line_is_refused_and_named(file: Path, text: str | None, complaint: str) -> None:
    if text is not None:
        file.write_text(text)
    with pytest.raises(BadInputError, match=complaint) as refused:
        read("--settings", str(file))
    assert refused.value.kind == "bad_setting"


@pytest.mark.parametrize("name", ["CAIRN_QUOTAS__BYTES_PER_DAY", "CAIRN_QUOTAS", "CAIRN_HEAD_S"])
def test_a_wrong_variable_is_refused_and_named(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(name, "many" if name != "CAIRN_QUOTAS" else '{"bytes_per_day": -1}')
    with pytest.raises(BadInputError, match=f"^{name}: "):
        read()


def test_a_variable_that_is_no_json_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CAIRN_QUOTAS", "{")
    with pytest.raises(BadInputError, match="quotas"):
        read()


def test_a_variable_of_many_brackets_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CAIRN_QUOTAS", "[" * 50_000)
    with pytest.raises(BadInputError, match="environment"):
        read()


@pytest.mark.parametrize("flag", ["--settings", "--admin-token-file"])
def test_a_file_without_end_is_refused_unread(flag: str) -> None:
    with pytest.raises(BadInputError, match="/dev/zero has more than 1048576 bytes"):
        read(flag, "/dev/zero")


@pytest.mark.parametrize("argv", [("--port", "many"), ("--branch-expiry", "1"), ("--admin-token-file", "short")])
def test_a_wrong_flag_is_refused_and_named(
    argv: tuple[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("short").write_text("short")
    with pytest.raises(BadInputError, match=f"^{argv[0]}: "):
        read(*argv)


@pytest.mark.parametrize("flag", sorted(MOVED))
def test_a_removed_flag_is_answered_with_the_line_that_replaces_it(flag: str, file: Path) -> None:
    with pytest.raises(BadInputError, match=f"^{flag} is a setting now") as refused:
        read(f"{flag}=64")
    line = refused.value.message.split("`")[1]
    file.write_text(line)
    found = read("--settings", str(file)).model_dump()
    names, factor = MOVED[flag][0].split("."), MOVED[flag][1]
    for name in names:
        found = found[name]
    assert found == 64 * factor
    assert tomllib.loads(line)


def test_the_help_lists_every_setting_by_flag_or_by_name() -> None:
    text = serve_parser("").format_help()
    assert "--keep-evidence SECONDS" in text
    assert "  fold_lag_max_s = 600\n" in text
    assert "  quotas.bytes_per_day = 128_000_000_000\n" in text
    named = {name for name in Settings.model_fields if f"  {name} = " in text or f"  {name}." in text}
    assert len(named) == 18
