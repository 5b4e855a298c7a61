"""Whether a soak was good: the bars of `make soak`, and the figures behind them."""

from collections.abc import Iterator

from tests.crowd.figures import Times, fold_lags, rise_of
from tests.crowd.soak import Outcome
from tests.crowd.watch import Sample

FETCH_P99_MS = 500.0
PUSH_P99_MS = 150.0
LAG_P99_MS = 3000.0
SKIPPED_SHARE = 0.01
"""Of all rounds."""
FLAT_SECONDS = 240.0
"""Shorter soaks say nothing of memory: caches are still filling."""
FLAT_SHARE = 0.02
"""The straight line through the memory of the last half rises by less than this share of it, or by less than"""
FLAT_NOISE = 3.0
"""so many standard deviations of what lies beside the line."""


def findings(outcome: Outcome) -> list[str]:
    """What is not as it has to be."""
    seen, whole, crowd = outcome.seen, outcome.whole, outcome.crowd
    found = [f"{count} times {kind}" for kind, count in seen.errors.most_common()]
    found += whole.errors[:10] + whole.different[:10]
    if not whole.cells:
        found.append("no whole robot compared its map")
    if outcome.at_head != crowd.robots:
        found.append(f"{crowd.robots - outcome.at_head} robots did not come to the head")
    if seen.fetches.ms(0.99) >= FETCH_P99_MS:
        found.append(f"p99 of fetches is {seen.fetches.ms(0.99):.0f} ms, to be below {FETCH_P99_MS:g}")
    if seen.pushes.ms(0.99) >= PUSH_P99_MS:
        found.append(f"p99 of pushes is {seen.pushes.ms(0.99):.0f} ms, to be below {PUSH_P99_MS:g}")
    if (lag_ms := _lags(outcome).ms(0.99)) >= LAG_P99_MS:
        found.append(f"p99 of the fold lag is {lag_ms:.0f} ms, to be below {LAG_P99_MS:g}")
    if seen.skipped > SKIPPED_SHARE * len(seen.fetches):
        found.append(f"{seen.skipped} rounds were skipped, of {len(seen.fetches)}")
    if (grown := _grown(outcome)) is not None:
        found.append(grown)
    if outcome.exit_code or outcome.complaints:
        found.append(f"the server ended with {outcome.exit_code} and said: {outcome.complaints[:1000]}")
    return found


def summary(outcome: Outcome) -> Iterator[str]:
    """The figures."""
    seen, info, whole = outcome.seen, outcome.info, outcome.whole
    yield f"{outcome.crowd}"
    yield f"the map: {info.cells} cells of {info.size_bytes / 1e6:.1f} MB, {info.commits} commits in the end"
    errors = dict(seen.errors) or "none"
    yield f"errors: {errors}; rounds skipped: {seen.skipped}; {outcome.at_head} robots at the head in the end"
    yield f"first fetch (whole map): {seen.joins}"
    yield f"fetch:  {seen.fetches}"
    yield f"push:   {seen.pushes}"
    yield f"from a push's answer until listeners hear of a map with it: {_lags(outcome)}"
    yield f"status: {seen.reports}"
    frames = ", ".join(f"{kind.name.lower()} {count}" for kind, count in sorted(seen.frames.items()))
    yield f"received {seen.received_bytes / 1e6:.0f} MB, sent {seen.sent_bytes / 1e6:.0f} MB; frames: {frames}"
    yield f"live events: {dict(seen.events)}"
    yield (
        f"whole robots: {whole.rounds} rounds, {whole.frames} frames, {len(whole.pushed_s)} commits; "
        f"{whole.cells} cells compared byte for byte, {len(whole.different)} different"
    )
    yield f"server's memory: {', '.join(_minutes(outcome))}"
    samples = _last_half(outcome)
    rise, noise = _rise(samples)
    yield f"  over the last half: {rise / 1e6:+.2f} MB along the line, {noise / 1e6:.2f} MB (1 sigma) beside it"
    first, last = outcome.samples[0], outcome.samples[-1]
    yield f"server's processor time: {(last.cpu_s - first.cpu_s) / (last.time_s - first.time_s):.2f} of a core"


def _lags(outcome: Outcome) -> Times:
    seen = outcome.seen
    return fold_lags(seen.pushed_s + outcome.whole.pushed_s, seen.heads, seen.folded_before)


def _minutes(outcome: Outcome) -> Iterator[str]:
    end_s = outcome.start_s + outcome.crowd.seconds
    minute = -1
    for sample in outcome.samples:
        if sample.time_s <= end_s and (since := int((sample.time_s - outcome.start_s) // 60)) > minute:
            minute = since
            yield f"{sample.resident_bytes / 1e6:.0f}"
    yield f"{outcome.samples[-1].resident_bytes / 1e6:.0f} MB in the end"


def _last_half(outcome: Outcome) -> list[Sample]:
    """Of the time in which the crowd was there."""
    end_s = outcome.start_s + outcome.crowd.seconds
    half_s = outcome.start_s + outcome.crowd.seconds / 2
    return [sample for sample in outcome.samples if half_s <= sample.time_s <= end_s]


def _rise(samples: list[Sample]) -> tuple[float, float]:
    return rise_of([sample.time_s for sample in samples], [sample.resident_bytes for sample in samples])


def _grown(outcome: Outcome) -> str | None:
    if outcome.crowd.seconds < FLAT_SECONDS:
        return None
    samples = _last_half(outcome)
    rise, noise = _rise(samples)
    mean = sum(sample.resident_bytes for sample in samples) / len(samples)
    if rise < max(FLAT_SHARE * mean, FLAT_NOISE * noise):
        return None
    return f"memory rose by {rise / 1e6:.1f} MB in the last half, of {mean / 1e6:.0f} MB"
