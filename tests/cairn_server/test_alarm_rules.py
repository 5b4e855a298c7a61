"""The alarms for Prometheus and the dashboard for Grafana: PromQL, about figures and labels that there are."""

import json
import re
from collections.abc import Iterator
from typing import Any

import promql_parser
import pytest
import yaml
from promql_parser import AggregateExpr, BinaryExpr, Call, Expr, MatrixSelector, ParenExpr, VectorSelector
from tests.fixtures.server.live import Live
from tests.fixtures.server.prometheus_text import Family, families_of
from tests.fixtures.server.protocol_document import ROOT
from tests.fixtures.server.pushes import MOLE, pushed

ADMIN = {"Authorization": "Bearer " + "a" * 20}
SCRAPED = frozenset({"instance", "job"})
"""Labels that Prometheus itself gives."""
OF_PROMETHEUS = "up"
OF_SOME = {
    "cairn_backup_age_seconds",
    "cairn_certificate_expiry_seconds",
    "cairn_robot_silence_seconds",
    "cairn_upstream_up",
}
"""Figures that only some servers have."""


@pytest.fixture(scope="module")
def families(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Family]:
    """Figures of a server that took commits of a robot, and refused some."""
    with Live(tmp_path_factory.mktemp("data"), admin_token="a" * 20, metrics_open=True) as live:
        row = live.new_map()
        body = {"robot": "mole", "incarnation": MOLE.incarnation}
        token = live.http.post(f"/maps/{row.name}/branches", json=body, headers=ADMIN).json()["token"]
        for seed in (0, 1):
            live.push(row, pushed(0, seed), headers={"Authorization": f"Bearer {token}"})
        live.folded(row)
        live.http.get("/nothing")
        return families_of(live.http.get("/metrics").text)


def rules() -> list[dict[str, Any]]:
    groups = yaml.safe_load((ROOT / "docker" / "prometheus-rules.yaml").read_text())["groups"]
    return [rule for group in groups for rule in group["rules"]]


def shown() -> list[str]:
    """Expressions of the dashboard, its variables replaced."""
    dashboard = json.loads((ROOT / "docker" / "grafana-dashboard.json").read_text())
    return [target["expr"] for panel in dashboard["panels"] for target in panel.get("targets", ())]


def parts(expression: Expr) -> Iterator[Expr]:
    """An expression and all that it is made of."""
    yield expression
    match expression:
        case BinaryExpr():
            inner = [expression.lhs, expression.rhs]
        case AggregateExpr() | ParenExpr():
            inner = [expression.expr]
        case MatrixSelector():
            inner = [expression.vector_selector]
        case Call():
            inner = list(expression.args)
        case _:
            inner = []
    for each in inner:
        yield from parts(each)


def selectors(expression: Expr) -> Iterator[VectorSelector]:
    yield from (part for part in parts(expression) if isinstance(part, VectorSelector))


def check(text: str, families: dict[str, Family]) -> None:
    """Each selector names a family and labels of it."""
    found = list(selectors(promql_parser.parse(text)))
    assert found, text
    for selector in found:
        name = str(selector.name)
        if name == OF_PROMETHEUS or name in OF_SOME - families.keys():
            continue
        family = families[name.removesuffix("_bucket")]
        labels = {label for _, sample in family.samples for label, _ in sample}
        asked = {matcher.name for matcher in selector.matchers.matchers} - SCRAPED
        assert not family.samples or asked <= labels, text


def test_every_alarm_is_about_figures_that_there_are_by_labels_that_they_have(families: dict[str, Family]) -> None:
    for rule in rules():
        check(rule["expr"], families)
        assert rule["labels"]["severity"] in ("critical", "warning")
        assert rule["annotations"]["summary"]


def test_every_panel_is_about_figures_that_there_are_by_labels_that_they_have(families: dict[str, Family]) -> None:
    assert len(shown()) > 20
    for text in shown():
        check(text, families)
        aggregates = [part for part in parts(promql_parser.parse(text)) if isinstance(part, AggregateExpr)]
        known = {label for selector in selectors(promql_parser.parse(text)) for label in labels_of(selector, families)}
        by = {label for part in aggregates if part.modifier for label in part.modifier.labels}
        assert by <= known | SCRAPED, text


def labels_of(selector: VectorSelector, families: dict[str, Family]) -> set[str]:
    family = families[str(selector.name).removesuffix("_bucket")]
    return {label for _, sample in family.samples for label, _ in sample} or {"what", "kind", "map", "robot"}


def test_an_alarm_on_a_level_holds_where_its_series_is_missing(families: dict[str, Family]) -> None:
    without = {"CairnFoldLag", "CairnShareFills", "CairnRobotsSilent"}
    """No series is the good case: nothing waits, no share is half full, no robot is known."""
    for rule in rules():
        if "increase(" in rule["expr"] or "rate(" in rule["expr"] or rule["alert"] in without:
            continue
        assert "absent(" in rule["expr"] or " unless " in rule["expr"], rule["alert"]


def test_the_alarms_that_the_handbook_promises_are_there() -> None:
    names = {rule["alert"] for rule in rules()}
    handbook = (ROOT / "docs" / "administrator.md").read_text()
    rows = [line.split("|")[1] for line in handbook.splitlines() if line.startswith("| `Cairn")]
    listed = {name for row in rows for name in re.findall(r"`(Cairn[A-Za-z]+)`", row)}
    assert listed == names


def test_a_text_that_is_no_promql_is_found_out() -> None:
    for text in ("cairn_ready ==", "rate(cairn_pushes_total)", "sum by map (cairn_ready)"):
        with pytest.raises(ValueError):
            promql_parser.parse(text)
