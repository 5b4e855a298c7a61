"""Layers on the page: each is chosen by its name, drawn as a map is, and shows the marks of its map."""

import pytest
from playwright.sync_api import Browser
from tests.console.browsing import VIEW, tab
from tests.console.hot_room import GEOMETRY, commit_of
from tests.console.hot_room import room as warm_room
from tests.console.room import Room
from tests.fixtures.server.deadline import until

from cairn_map.wire.layer_messages import AddLayer
from cairn_map.wire.mark_messages import MarkRequest, MarkText
from cairn_map.wire.messages import CreateMap

pytestmark = pytest.mark.browser

SITE, LAYER = "site", "site.fine"


def test_a_layer_is_chosen_by_its_name_and_has_the_marks_of_its_map(room: Room, chromium: Browser) -> None:
    with room.api as api:
        api.create_map(SITE, CreateMap(geometry=GEOMETRY))
        api.add_layer(SITE, AddLayer(name="fine", geometry=GEOMETRY))
        commit = commit_of(warm_room(), 0)
        api.push(LAYER, commit)
        until(lambda: any(entry.id == str(commit.id) for entry in api.log(LAYER)), "the layer's commit is folded")
        api.put_mark(SITE, MarkRequest(mark=MarkText(kind="door", name="north door", place_m=(1.0, 1.0, 1.0))))
    with chromium.new_context(viewport=VIEW, color_scheme="dark") as context:
        console = tab(context, room)
        console.open(f"#map={LAYER}")
        console.log_in()
        console.settled()
        choice = console.page.get_by_role("combobox", name="Map")
        assert choice.input_value() == LAYER
        assert {SITE, LAYER} <= set(choice.evaluate("(each) => [...each.options].map(({ value }) => value)"))
        assert console.tell("c.cells.drawn") > 0
        console.until("c.findings.all.some(({ title }) => title.includes('north door'))", "the map's mark is listed")
        choice.select_option(SITE)
        console.page.get_by_role("heading", name="Nothing is in this map yet").wait_for()
