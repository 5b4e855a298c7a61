"""Checks of `cairn doctor` of the servers behind an address: whether they share one store, who folds, versions, clocks.

The address is asked several times, each time over a new connection, so that a proxy that spreads requests shows all of
its servers. One that sends a client to the same server each time needs the servers' own addresses.
"""

from collections import Counter
from collections.abc import Iterator, Sequence

from cairn_client.cli.doctor.checks import Check, CheckResult
from cairn_client.http.api import MapApi
from cairn_map.errors import CairnError, DeniedError, NotFoundError
from cairn_map.wire.access_messages import ServerInfo, SiteInfo
from cairn_map.wire.origins import origin_of

ASKS = 10
"""Requests to each address: a proxy that picks one of two servers by chance shows one alone once in 500 times."""
WAITING_WARN_S = 120.0
"""Time for which a commit may wait to be folded, as in the alarms of docs/administrator.md."""
CLOCK_WARN_S = 5.0
"""Seconds between the clocks of servers, or of one and the database: ends of tokens and days of quotas go by them."""


def site_checks(addresses: Sequence[tuple[str, str | None]]) -> Iterator[Check]:
    """Checks of the servers behind these URLs, each with a token."""
    answers: list[tuple[str, SiteInfo]] = []
    for place, (url, token) in enumerate(addresses):
        try:
            answers += _asked(url, token)
        except (DeniedError, NotFoundError) as exc:
            if exc.kind == "no_route":
                advice = "update it: it does not say which servers there are"
                yield Check("servers", CheckResult.WARN, f"the server at {url} is of an older version", advice)
            elif place > 0:  # what the first one says of its token is a check of its own
                advice = f"give it its own token: --token {origin_of(url)}=TOKEN"
                yield Check("servers", CheckResult.FAIL, f"{url}: {exc.message} [{exc.kind}]", advice)
            return
        except CairnError as exc:
            yield Check("servers", CheckResult.FAIL, f"{url}: {exc.message} [{exc.kind}]", "look at that server's log")
            return
    yield from checks_of(answers)


def checks_of(answers: Sequence[tuple[str, SiteInfo]]) -> Iterator[Check]:
    """Checks of answers, each with the URL that gave it."""
    yield _store(answers)
    sites = {site.store_id: site for _, site in answers}
    for site in sites.values():
        yield _servers(site)
        yield _folding(site)
        if site.clock is not None:
            yield _trust(site.clock)
        if site.store == "shared":
            yield _clocks(site)


def _asked(url: str, token: str | None) -> Iterator[tuple[str, SiteInfo]]:
    for _ in range(ASKS):
        with MapApi(url, token=token) as api:
            yield url, api.site()


def _store(answers: Sequence[tuple[str, SiteInfo]]) -> Check:
    """Check that all answers are of one store: else robots push to one and read another."""
    stores = Counter((site.store_id, site.store) for _, site in answers)
    places = {url for url, _ in answers}
    if len(stores) > 1:
        shares = "; ".join(f"{count} of store {store_id} ({kind})" for (store_id, kind), count in stores.items())
        found = f"{len(stores)} stores answer behind {' and '.join(sorted(places))}: of {len(answers)} answers {shares}"
        advice = (
            "take all but one out of the proxy now, then give all servers one --store postgresql://... "
            "(docs/scale.md): what is pushed to one is missing at the others"
        )
        return Check("store", CheckResult.FAIL, found, advice)
    (store_id, kind), _ = stores.popitem()
    seen = len({site.server_id for _, site in answers})
    where = "one process has it" if kind == "one process" else f"shared; {seen} of its servers answered here"
    return Check("store", CheckResult.OK, f"{store_id}, {where}")


def _servers(site: SiteInfo) -> Check:
    answering = sum(server.answers for server in site.servers)
    folding = sum(server.folds for server in site.servers)
    versions = sorted({server.version for server in site.servers})
    found = f"{len(site.servers)}: {answering} answer, {folding} fold; version {', '.join(versions)}"
    if len(versions) > 1:
        return Check("servers", CheckResult.WARN, found, "finish the upgrade: docs/scale.md")
    return Check("servers", CheckResult.OK, found)


def _folding(site: SiteInfo) -> Check:
    waiting = f"the oldest commit has waited for {site.waiting_s:.1f} s" if site.waiting_s else "no commit waits"
    if not any(server.folds for server in site.servers):
        advice = "start one with --fold-only, or without --no-fold: what is pushed is kept, and reaches no other robot"
        return Check("folding", CheckResult.FAIL, f"no server folds; {waiting}", advice)
    ages_s = [server.folded_s for server in site.servers if server.folded_s is not None]
    found = f"{waiting}; " + (f"the last fold was {min(ages_s):.0f} s ago" if ages_s else "nothing was folded yet")
    if site.waiting_s > WAITING_WARN_S:
        return Check("folding", CheckResult.WARN, found, "see the log of the servers that fold, and their processors")
    return Check("folding", CheckResult.OK, found)


def _trust(complaint: str) -> Check:
    advice = (
        "set its clock (NTP, chrony); if it is right as it is, say so: curl -X POST -H 'Authorization: Bearer TOKEN' "
        "URL/clock (docs/administrator.md)"
    )
    return Check("server's clock", CheckResult.WARN, complaint, advice)


def _clocks(site: SiteInfo) -> Check:
    def lead_s(server: ServerInfo) -> float:
        return abs(server.clock_ahead_s)

    worst = max(site.servers, key=lead_s)
    found = f"the servers' differ from the database's by at most {lead_s(worst):.2f} s"
    if lead_s(worst) > CLOCK_WARN_S:
        return Check(
            "clocks", CheckResult.WARN, f"{found} (server {worst.id})", "set the machines' clocks (NTP, chrony)"
        )
    return Check("clocks", CheckResult.OK, found)
