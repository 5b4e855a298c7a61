"""Choice of the range bias's shapes: those that the ranges and amplitudes of the boards' images determine.

A wave that was seen only in part looks like an offset and a scale, a dependence on the amplitude that hardly
changed like an offset: both then fit, and both are wrong a metre further on. They are left out, and a warning says why.
"""

from dataclasses import dataclass

import numpy as np

from cairn_calib.board.board import Board
from cairn_calib.rig.range_terms import RangeTerms, wave_period_m
from cairn_calib.solve.range_residuals import RangeData, plane_ranges
from cairn_calib.solve.rig_state import RigState
from cairn_map.errors import BadInputError

HARMONICS = (1, 2, 4)
"""Harmonics of the modulation that are estimated: `range_terms.py`."""
PERIOD_SHARE = 0.75
"""Share of a wave's period that the ranges must cover."""
AMPLITUDE_RATIO = 2.0
"""Ratio of the highest to the lowest amplitude that determines a dependence on it."""
TIMES_MAX = 1.5
"""Ratio between measured and true distances, at most, either way: no camera errs so much, but units may differ."""
ENDS = (2.0, 98.0)
"""Percentiles that are taken for nearest and farthest, faintest and brightest."""


@dataclass(frozen=True, slots=True)
class RangeSpans:
    """Distances and amplitudes that the boards' pixels covered."""

    nearest_m: float
    farthest_m: float
    amplitudes: tuple[float, float, float] | None
    """Lowest, middle and highest, counts; None unless all images have amplitudes."""

    @property
    def span_m(self) -> float:
        """Distance from the nearest to the farthest, metres."""
        return self.farthest_m - self.nearest_m

    @property
    def amplitude_ratio(self) -> float:
        """Highest amplitude over the lowest; 0 where they are unknown."""
        return 0.0 if self.amplitudes is None else self.amplitudes[2] / self.amplitudes[0]

    def period_share(self, modulation_hz: float, harmonic: int) -> float:
        """Share of a wave's period that the ranges cover."""
        return self.span_m / wave_period_m(modulation_hz, harmonic)


def range_spans(data: RangeData, state: RigState, board: Board) -> RangeSpans:
    """Distances and amplitudes of all pixels on boards.

    Raises:
        BadInputError: the ranges are in other units than the board.
    """
    seen = data.measured
    true_m, measured_m = (each[seen] for each in plane_ranges(data, state, board))
    # Ranges in other units would be met by an absurd scale.
    times = float(np.median(measured_m / true_m))
    if not 1 / TIMES_MAX < times < TIMES_MAX:
        raise BadInputError(
            "range_units",
            f"the range images are {times:.3g} times as long as the way to the boards, by their corners and pitch: "
            "check --range-units-per-m, and the --square that the corners were found with",
        )
    near, far = np.percentile(true_m, ENDS)
    amplitude = data.amplitude[seen]
    if not np.isfinite(amplitude).all():
        return RangeSpans(float(near), float(far), None)
    low, middle, high = np.percentile(amplitude, (ENDS[0], 50.0, ENDS[1]))
    return RangeSpans(float(near), float(far), (float(low), float(middle), float(high)))


def choose_terms(spans: RangeSpans, modulation_hz: float | None) -> RangeTerms:
    """Shapes of the range bias that these spans determine."""
    waves = () if modulation_hz is None else HARMONICS
    harmonics = tuple(k for k in waves if spans.period_share(modulation_hz or 0.0, k) >= PERIOD_SHARE)
    known = spans.amplitudes is not None and spans.amplitude_ratio >= AMPLITUDE_RATIO
    return RangeTerms(
        modulation_hz if harmonics else None, harmonics, spans.amplitudes[1] if known and spans.amplitudes else None
    )
