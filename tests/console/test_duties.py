"""The panel for operators: robots that ask to be let in under another key, and shares that are half used."""

import re
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from playwright.sync_api import Browser, BrowserContext, Locator
from tests.console.browsing import OVERFLOWING, UPRIGHT, VIEW, Console, serious, tab
from tests.console.room import ADMIN_TOKEN, Room
from tests.fixtures.map.made import SMALL
from tests.fixtures.server.pushes import pushed
from tests.fixtures.server.signatures import KEY_OF, MOLE, OLD_MOLE

from cairn_map.commits.ids import Author, Incarnation, RobotName
from cairn_map.commits.signature import signatures_to_text
from cairn_map.errors import DeniedError
from cairn_map.wire.access_messages import CreateToken
from cairn_map.wire.messages import CreateMap, Register

pytestmark = pytest.mark.browser

GATE = "gate"
FINCH = RobotName("finch")
THIEF = MOLE._replace(incarnation=Incarnation("0123456789abcdef"))
INCARNATIONS = 9
"""More than half of a robot's."""
HOSTILE = "<img src=x onerror=alert(1)>"


class Gate:
    """A map on which mole is known by its key, and who may do what there."""

    def __init__(self, room: Room) -> None:
        self.room = room
        self.robot = room.api
        with room.api as admin:
            admin.create_map(GATE, CreateMap(geometry=SMALL))
            self.tokens = {
                role: admin.create_token(f"gate-{role}", CreateToken(role=role, map=GATE)).token
                for role in ("operator", "reader")
            } | {"admin": ADMIN_TOKEN}
        self.robot.register(GATE, Register(robot=MOLE.robot, incarnation=MOLE.incarnation))
        self.push(MOLE)

    def push(self, author: Author) -> None:
        """A commit by mole's token, signed by the author's key where it has one."""
        commit = pushed(0, 0, author)
        key = KEY_OF.get(author)
        signatures = signatures_to_text([key.sign(GATE, commit.sha)]) if key else None
        self.robot.push(GATE, commit, signatures=signatures)

    def asks(self, author: Author) -> None:
        """The push is refused, and the robot is on the list."""
        with pytest.raises(DeniedError, match=r"robots admit") as caught:
            self.push(author)
        assert caught.value.kind == "not_admitted"


@pytest.fixture(scope="module")
def gate(room: Room) -> Iterator[Gate]:
    made = Gate(room)
    with made.robot:
        yield made


@pytest.fixture(scope="module")
def context(chromium: Browser) -> Iterator[BrowserContext]:
    with chromium.new_context(viewport=VIEW, color_scheme="dark") as made:
        yield made


@contextmanager
def seen_by(role: str, gate: Gate, context: BrowserContext) -> Iterator[Console]:
    """A tab that shows the map to who has a token of this role."""
    console = tab(context, gate.room)
    console.open(f"#map={GATE}")
    console.log_in(gate.tokens[role])
    console.settled()
    console.errors.clear()  # the browser tells of the 401 before
    yield console
    console.page.close()


@pytest.fixture(scope="module")
def desk(gate: Gate, context: BrowserContext) -> Iterator[Console]:
    """An operator's tab."""
    with seen_by("operator", gate, context) as console:
        yield console


def duties(console: Console) -> Locator:
    """The panel, which is there only while something waits."""
    console.tell("c.duties.refresh()")
    return console.page.get_by_role("region", name="For an operator")


def digits(author: Author) -> str:
    """The key as the page writes it."""
    return " ".join(re.findall("....", author.incarnation))


def test_an_operator_compares_the_key_of_a_robot_that_asks_and_lets_it_in(gate: Gate, desk: Console) -> None:
    page = desk.page
    duties(desk).wait_for(state="hidden")
    gate.asks(OLD_MOLE)
    row = duties(desk).get_by_role("listitem")
    row.get_by_text("mole asks to be let in").wait_for()
    row.get_by_text(digits(OLD_MOLE)[:9]).wait_for()
    found = serious(desk, "a robot asks")
    page.set_viewport_size(UPRIGHT)
    assert page.evaluate(OVERFLOWING) == []
    page.set_viewport_size(VIEW)
    row.get_by_role("button", name="Compare").click()
    dialog = page.get_by_role("dialog", name="Is this mole?")
    for author in (MOLE, OLD_MOLE):
        dialog.get_by_text(digits(author), exact=True).wait_for()
    dialog.get_by_text(f"token {GATE}:mole").wait_for()
    found += serious(desk, "the keys of a robot that asks")
    dialog.get_by_role("button", name="Admit this key").click()
    dialog.get_by_text("Done: this key may speak for mole").wait_for()
    assert found == []
    page.keyboard.press("Escape")
    duties(desk).wait_for(state="hidden")
    gate.push(OLD_MOLE)
    with gate.room.api as api:
        admitted = {key.author: key.by for key in api.keys(GATE).admitted}
    assert admitted[str(OLD_MOLE)] == "gate-operator"
    assert desk.errors == []


def test_a_robot_that_is_refused_stays_out_and_is_pointed_at_no_more(gate: Gate, desk: Console) -> None:
    gate.asks(THIEF)
    duties(desk).get_by_role("button", name="Compare").click()
    desk.page.get_by_role("button", name="Refuse").click()
    desk.page.get_by_text(f"end the token {GATE}:mole").wait_for()
    desk.page.keyboard.press("Escape")
    duties(desk).get_by_text("mole is refused").wait_for()
    desk.page.reload()
    desk.settled()
    duties(desk).get_by_text("mole is refused").wait_for()
    gate.asks(THIEF)
    with gate.room.api as api:
        assert str(THIEF) not in {key.author for key in api.keys(GATE).admitted}
    desk.page.evaluate("localStorage.clear()")


def test_what_a_server_says_of_robots_that_ask_is_text(gate: Gate, desk: Console) -> None:
    gate.asks(THIEF)
    told = {"author": f"{HOSTILE}.{THIEF.incarnation}", "since_s": 1e9, "asked_s": 1e9, "by": HOSTILE}
    answer = {"admitted": [], "asking": [told]}
    desk.page.route(f"**/maps/{GATE}/keys", lambda route: route.fulfill(json=answer))
    duties(desk).get_by_text(f"{HOSTILE} asks").wait_for()
    duties(desk).get_by_role("button").click()
    dialog = desk.page.get_by_role("dialog")
    dialog.get_by_text(f"token {HOSTILE}").wait_for()
    assert desk.page.locator("img").count() == 0
    dialog.get_by_role("button", name="Back").click()
    desk.page.unroute(f"**/maps/{GATE}/keys")
    assert desk.errors == []


def test_a_reader_is_not_asked_for_a_word(gate: Gate, context: BrowserContext) -> None:
    gate.asks(THIEF)
    with seen_by("reader", gate, context) as console:
        console.until("c.duties.isMine === false", "the server refuses")
        duties(console).wait_for(state="hidden")
        console.until("c.duties.askAtMs === 0", "nothing more is asked")
        told = [url for url in console.requests if re.search(rf"/maps/{GATE}/(keys|robots)$", url)]
        assert [url.rsplit("/", 1)[1] for url in told] == ["keys"]


def test_a_share_that_is_half_used_is_shown_and_an_administrator_closes_its_robot(
    gate: Gate, desk: Console, context: BrowserContext
) -> None:
    with gate.room.api as api:
        for n in range(INCARNATIONS):
            api.push(GATE, pushed(n, n, Author(FINCH, Incarnation(f"{n:016x}"))))
        api.register(GATE, Register(robot=FINCH, incarnation=f"{0:016x}"))
    said = f"incarnations {round(100 * INCARNATIONS / 16)} %"
    row = duties(desk).get_by_role("listitem").filter(has_text="finch")
    row.get_by_text(said).wait_for()
    desk.tell("c.team.refresh()")
    team = desk.page.locator(".robot", has=desk.page.locator(f'[data-robot="{FINCH}"]'))
    team.get_by_text(f"uses more than half of its share: {said}").wait_for()
    row.get_by_role("button", name="Shares").click()
    desk.page.get_by_role("button", name="Close finch").click()
    desk.page.get_by_role("dialog", name="Shares of finch").locator(".error").wait_for()
    desk.page.keyboard.press("Escape")
    with seen_by("admin", gate, context) as admin:
        duties(admin).get_by_role("listitem").filter(has_text="finch").get_by_role("button").click()
        admin.page.get_by_role("button", name="Close finch").click()
        admin.page.get_by_text(f"Done: {INCARNATIONS} incarnations closed").wait_for()
        admin.page.keyboard.press("Escape")
        duties(admin).get_by_text("finch").wait_for(state="detached")
        assert admin.errors == []
    duties(desk).get_by_text("finch").wait_for(state="detached")
    team.get_by_text("uses more than half").wait_for(state="detached")
