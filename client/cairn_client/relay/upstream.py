"""Upstream relay: the thread by which `cairn serve --upstream` keeps a server level with another one.

The maps of the upstream server are made here if they are not, up to a number (`OwnServer.open`), and from then on hold
the same commits. Without a link both servers go on by themselves. One map's answers hold up no other map: nonsense is
reported and passed over, and after an answer that never ended the next round begins with the map behind it.
"""

import logging
import threading
import time

from cairn_client.http.backoff import Backoff
from cairn_client.http.request_deadline import PACE, Pace
from cairn_client.relay.carried_attachments import hand_over_attachments
from cairn_client.relay.link import RelayApi, ServerEnd, hold_between
from cairn_client.relay.round import RelayReport, RelaySide, Undelivered, log_report, relay_round
from cairn_map.commits.ids import map_of_layer
from cairn_map.errors import CairnError, DeniedError, NotFoundError, UnreachableError
from cairn_map.wire.messages import MapInfo
from cairn_map.wire.relay_peer import TOO_MANY_MAPS, OwnServer

log = logging.getLogger(__name__)

EVERY_S = 5.0
"""Rounds without anything to hand over take two small requests."""
STOP_S = 3.0
SAY_AGAIN_S = 600.0


class Upstream:
    """Relays between a server and its upstream until stopped."""

    def __init__(
        self, url: str, token: str | None, server: OwnServer, *, every_s: float = EVERY_S, pace: Pace = PACE
    ) -> None:
        """Begin.

        Raises:
            BadInputError: the URL is none of a server.
        """
        logging.getLogger("httpx").setLevel(logging.WARNING)  # a line for each request is no help in a server's log
        self._api = RelayApi(url, token=token, pace=pace)
        self._url = url
        self._server = server
        self._every_s = every_s
        self._resting: dict[str, Undelivered] = {}
        self._said_s: dict[str, float] = {}
        self._last_name = ""
        """The map that was relayed last: the next round begins behind it."""
        self._stopping = threading.Event()
        self._woken = threading.Event()
        self._thread = threading.Thread(target=self._run, name="cairn-upstream", daemon=True)
        self._thread.start()

    def wake(self) -> None:
        """Do a round soon: there is something new here."""
        self._woken.set()

    def use_token(self, token: str | None) -> None:
        """Show the upstream server this token from now on."""
        self._api.use_token(token)

    def stop(self) -> None:
        """End soon, in the middle of a round if the link is slow: what was not handed over will be."""
        self._stopping.set()
        self._woken.set()
        self._thread.join(STOP_S)
        if not self._thread.is_alive():
            self._api.close()

    def _run(self) -> None:
        backoff = Backoff()
        while not self._stopping.is_set():
            self._woken.clear()
            try:
                has_more = self._round()
            except UnreachableError as exc:
                self._server.note_round(None, exc)
                what = "no link to" if exc.kind == "no_link" else f"nothing taken now ({exc.kind}) by"
                self._say(logging.WARNING, f"{what} upstream {self._url}, going on alone: {exc.message}")
                self._stopping.wait(backoff.next_s(exc.retry_after_s))
            except CairnError as exc:
                self._server.note_round(None, exc)
                self._say(logging.ERROR, f"upstream {self._url}: {exc.kind}: {exc.message}")
                self._stopping.wait(backoff.next_s(None))
            except Exception as exc:
                self._server.note_round(None, CairnError("internal", type(exc).__name__))
                log.exception("upstream %s: the relay failed, and tries again", self._url)
                self._stopping.wait(backoff.next_s(None))
            else:
                backoff.reset()
                if not has_more:
                    self._woken.wait(self._every_s)

    def _round(self) -> bool:
        """Relay all maps once; True if there is more to do at once.

        Raises:
            UnreachableError: the link broke, or a request ran out of time.
        """
        found = sorted(self._api.maps(), key=lambda info: (info.name <= self._last_name, info.name))
        self._server.note_round(None, None)
        own = set(self._server.map_names())
        for name in sorted(own - {info.name for info in found}):
            self._server.note_round(name, NotFoundError("no_map", "the upstream server has no such map for this token"))
            # A layer comes there with the commit of its map that defines it.
            if map_of_layer(name) is None:
                self._say(logging.WARNING, f"upstream {self._url} has no map {name} for this token; create it there")
        has_more, cut, is_full = False, None, False
        refused: list[tuple[str, CairnError]] = []
        for info in found:
            if self._stopping.is_set():
                return False
            if is_full and info.name not in own:
                continue
            try:
                report = self._relay(info)
            except UnreachableError as exc:
                cut = exc
                break
            except CairnError as exc:
                self._server.note_round(info.name, exc)
                refused.append((info.name, exc))
                is_full |= exc.kind == TOO_MANY_MAPS
                continue
            has_more, cut = has_more or report.has_more, cut or report.cut
        self._say_refused(refused)
        if cut:
            raise cut
        return has_more

    def _relay(self, info: MapInfo) -> RelayReport:
        """Report of one round with one map.

        Raises:
            CairnError: the map cannot be joined, or the upstream's answers are not sound.
        """
        here = self._server.open(info)
        self._last_name = info.name
        begun_s = self._server.clock_s()
        resting = self._resting.setdefault(info.name, Undelivered())
        was_refused = resting.is_refused(RelaySide.THERE)
        there = ServerEnd(self._api, info.name)
        report = hold_between(relay_round(resting), here, there)
        log_report(report, info.name, there=self._url)
        # A refused commit rests between two tries, and is refused meanwhile.
        is_refused = was_refused or resting.is_refused(RelaySide.THERE)
        ill = DeniedError("not_taken", "the upstream server refuses commits of this map") if is_refused else report.cut
        self._server.note_round(info.name, ill)
        if report.is_all_there:
            self._server.handed_over(info.name, begun_s)
        if not report.cut:
            report.has_more |= hand_over_attachments(here, there) > 0
        return report

    def _say_refused(self, refused: list[tuple[str, CairnError]]) -> None:
        """One line for the maps that could not be relayed, however many there are."""
        if refused:
            name, error = refused[0]
            others = f" (and {len(refused) - 1} others)" if len(refused) > 1 else ""
            self._say(logging.ERROR, f"map {name}{others} cannot be joined: {error.message}")

    def _say(self, level: int, text: str) -> None:
        """A line of the log, the same one not again too soon."""
        now_s = time.monotonic()
        if now_s - self._said_s.get(text, float("-inf")) >= SAY_AGAIN_S:
            self._said_s = {said: said_s for said, said_s in self._said_s.items() if now_s - said_s < SAY_AGAIN_S}
            self._said_s[text] = now_s
            log.log(level, "%s", text)
