"""The table of switches fits the sources; `python -m tests.rules_off` tries them."""

import pytest
from tests.rules_off.__main__ import ROOT
from tests.rules_off.switches import SWITCHES, Switch

NOT_BUILT = {16}
"""Nothing is built of it: servers to servers."""


@pytest.mark.parametrize("switch", SWITCHES, ids=lambda switch: f"{switch.rule}: {switch.without}")
def test_a_switch_finds_its_place_once_and_its_test(switch: Switch) -> None:
    assert (ROOT / switch.path).read_text().count(switch.old) == 1
    path, *names = switch.caught_by.split("::")
    assert (ROOT / "tests" / path).is_file()
    # Contract suites, whose tests a store's test file inherits, lie among the fixtures.
    contracts = (ROOT / "tests" / "fixtures").rglob("*_contract.py")
    sources = "".join(found.read_text() for found in [ROOT / "tests" / path, *contracts])
    assert all(name in sources for name in names)


def test_every_rule_that_is_built_has_a_switch() -> None:
    rules = {switch.rule for switch in SWITCHES if isinstance(switch.rule, int)}
    assert rules | NOT_BUILT == set(range(1, 17))
