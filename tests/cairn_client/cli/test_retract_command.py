"""Times as people write them, and a retract that is only looked at."""

import json
from datetime import UTC, datetime
from pathlib import Path

import pytest
from tests.fixtures.client.robot_program import RIG
from tests.fixtures.server.live import Live, live
from tests.fixtures.server.pushes import MOLE, WREN, pushed, read, sum_of

from cairn_client.cli.maps.command import seconds_of
from cairn_client.main import main
from cairn_map.errors import BadInputError

__all__ = ["live"]
NOW = datetime(2026, 11, 20, 15, 0, tzinfo=UTC)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("14:05", "2026-11-20T14:05:00+00:00"),
        ("14:05:30", "2026-11-20T14:05:30+00:00"),
        ("2026-11-19T23:00", "2026-11-19T23:00:00+00:00"),
        ("2026-11-20T14:05+01:00", "2026-11-20T13:05:00+00:00"),
        ("14:05+01:00", "2026-11-20T13:05:00+00:00"),
    ],
)
def test_a_time_is_of_today_and_utc_unless_it_says_otherwise(text: str, expected: str) -> None:
    seconds = seconds_of(text, now=NOW)
    assert seconds is not None
    assert datetime.fromtimestamp(seconds, UTC).isoformat() == expected


@pytest.mark.parametrize("text", ["", "noon", "25:00", "2026-13-01"])
def test_what_is_no_time_is_refused_with_an_example(text: str) -> None:
    with pytest.raises(BadInputError, match="14:05"):
        seconds_of(text, now=NOW)


def test_a_dry_run_names_the_commits_and_changes_nothing(live: Live, capsys: pytest.CaptureFixture[str]) -> None:
    row = live.new_map()
    commits = [pushed(n, n, author, rig="ab" * 32) for author in (MOLE, WREN) for n in range(2)]
    for commit in commits:
        live.push(row, commit)
    url = f"http://127.0.0.1:{live.port}/maps/{row.name}"
    wanted = ["map", "retract", url, "--robot", "mole", "--rig", "ab" * 32, "--pushed-after", "2020-01-01T00:00"]
    assert main([*wanted, "--dry-run"]) == 0
    shown = capsys.readouterr().out
    assert "would take out 2 commits" in shown and all(str(commit.id) in shown for commit in commits[:2])
    assert read(live.cells(row)) == sum_of(commits)
    assert main(wanted) == 0
    assert "takes out 2 commits" in capsys.readouterr().out
    assert read(live.cells(row)) == sum_of(commits[2:])


def test_a_rig_is_named_by_its_file_however_that_is_laid_out_and_the_log_says_why(
    live: Live, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    row, file = live.new_map(), tmp_path / "rig.json"
    rig = json.loads(RIG.to_json())
    file.write_text(json.dumps(dict(reversed(rig.items())), indent=4))
    commits = [pushed(0, 0, rig=RIG.digest(), note="the lens \x1b[2Jwas dirty"), pushed(1, 1, rig="ab" * 32)]
    for commit in commits:
        live.push(row, commit)
    url = f"http://127.0.0.1:{live.port}/maps/{row.name}"
    assert main(["map", "retract", url, "--rig", str(file), "--note", "calibrated again"]) == 0
    assert "takes out 1 commits" in capsys.readouterr().out
    assert read(live.cells(row)) == sum_of(commits[1:])
    for more in ([], ["--graph"]):
        assert main(["map", "log", url, *more]) == 0
        shown = capsys.readouterr().out
        assert "was dirty'" in shown and shown.count("calibrated again") == 1
        assert "\x1b" not in shown
    assert main(["map", "retract", url, "--rig", "rig.jsn"]) == 1
    assert "--rig takes a rig.json, or the 64 hex digits" in capsys.readouterr().err
