"""Scores of fused images: errors of temperature and colour pixel by pixel, and of occlusion labels.

    painted     pixels with a value, of all
    error       |fused - true| of painted pixels: median, 95 %, share above `LARGE`; also away from edges
    hidden      painted although no source sees the place, of painted
    precision   pixels called occluded that are hidden, of those called so
    recall      hidden pixels called occluded, of the hidden ones in view that have a depth
    ... +-1     the same, where one a range pixel away counts: the edge is measured no better

Pixels that look through glass or into a mirror are counted by themselves: there the range camera measured something
else.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields

import numpy as np

from cairn_fusion.image_fusion.cross_view import CrossView
from cairn_fusion.image_fusion.dense_depth import Origin
from cairn_fusion.transfer.transfer import Label
from cairn_map.arrays import Singles
from cairn_sim.evaluation.fusion_truth import FusionTruth, grown

LARGE: Mapping[str, float] = {"K": 2.0, "of 255": 20.0}
"""From which on an error shows."""
EMPTY = np.empty(0, np.float32)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FusionScores:
    """Counts and errors of one fused image or, added, of several."""

    unit: str
    pixels: int = 0
    painted: int = 0
    hidden_painted: int = 0
    hidden_painted_away: int = 0
    """Away from edges."""
    called: int = 0
    """Occluded, by the label, of those in view of the first source."""
    called_hidden: int = 0
    called_near: int = 0
    """Within a range pixel of one that is hidden."""
    hidden: int = 0
    """From the first source, in its view, and with a depth."""
    hidden_near: int = 0
    """Hidden pixels within a range pixel of one that was called occluded."""
    errors: Singles = field(default_factory=lambda: EMPTY)
    """Errors of painted pixels."""
    errors_away: Singles = field(default_factory=lambda: EMPTY)
    """Errors of painted pixels away from edges."""
    errors_filled: Singles = field(default_factory=lambda: EMPTY)
    """Errors of painted pixels whose depth was filled in."""
    errors_beyond: Singles = field(default_factory=lambda: EMPTY)
    """Errors of pixels that show things behind glass or in a mirror; counted in none of the others."""

    def __add__(self, other: "FusionScores") -> "FusionScores":
        added: dict[str, object] = {"unit": self.unit}
        for f in fields(self)[1:]:
            one, two = getattr(self, f.name), getattr(other, f.name)
            added[f.name] = np.concatenate([one, two]) if isinstance(one, np.ndarray) else one + two
        return FusionScores(**added)  # type: ignore[arg-type]

    @property
    def precision(self) -> float:
        """Share of the pixels called occluded that are hidden; 0 to 1, NaN for 0 of 0."""
        return self.called_hidden / self.called if self.called else math.nan

    @property
    def recall(self) -> float:
        """Share of the hidden pixels that are called occluded; 0 to 1, NaN for 0 of 0."""
        return self.called_hidden / self.hidden if self.hidden else math.nan

    @property
    def precision_near(self) -> float:
        """As `precision`, where a hidden pixel a range pixel away will do."""
        return self.called_near / self.called if self.called else math.nan

    @property
    def recall_near(self) -> float:
        """As `recall`, where a called pixel a range pixel away will do."""
        return self.hidden_near / self.hidden if self.hidden else math.nan

    def row(self) -> list[str]:
        """Text for a table, in the order of `COLUMNS`."""
        share, large = 100 / max(self.pixels, 1), LARGE[self.unit]
        return [
            f"{share * self.painted:.1f}",
            f"{_quantile(self.errors, 0.5):.2f}",
            f"{_quantile(self.errors, 0.95):.2f}",
            f"{100 * float((self.errors > large).mean()) if len(self.errors) else math.nan:.2f}",
            f"{_quantile(self.errors_away, 0.95):.2f}",
            f"{_quantile(self.errors_filled, 0.95):.2f}",
            f"{_quantile(self.errors_beyond, 0.5):.2f}",
            f"{100 * self.hidden_painted / max(self.painted, 1):.2f}",
            *(f"{100 * share:.1f}" if self.called else "-" for share in self._of_hidden),
        ]

    @property
    def _of_hidden(self) -> tuple[float, float, float, float]:
        return self.precision, self.recall, self.precision_near, self.recall_near


COLUMNS = (
    "painted %",
    "median",
    "95 %",
    "large %",
    "95 % away",
    "95 % filled",
    "beyond",
    "hidden %",
    "precision %",
    "recall %",
    "prec. +-1",
    "recall +-1",
)


def fusion_scores(fused: CrossView, truth: FusionTruth, *, unit: str) -> FusionScores:
    """The scores of one fused image.

    Args:
        fused: several sources' or one's.
        truth: of its sources, and possibly more.
        unit: of the values, one of `LARGE`.
    """
    ok, clear = fused.ok, ~truth.beyond
    error = np.abs(fused.values - truth.values).mean(axis=-1, dtype=np.float32)  # NaN where nothing is painted
    seen = np.zeros(ok.shape, np.bool_)
    for name in fused.sources:
        seen |= truth.sees[name]
    painted, first = ok & clear, fused.sources[0]
    # Only the first source's label is known where it alone was asked.
    alone = len(fused.sources) == 1
    judged = clear & truth.in_view[first] & ((fused.labels == Label.OK) | (fused.labels == Label.OCCLUDED)) & alone
    called, hidden = judged & (fused.labels == Label.OCCLUDED), judged & ~truth.sees[first]
    is_near_hidden = grown(truth.in_view[first] & ~truth.sees[first], truth.pixel_px)
    is_near_called = grown(fused.labels == Label.OCCLUDED, truth.pixel_px)
    return FusionScores(
        unit=unit,
        pixels=int(clear.sum()),
        painted=int(painted.sum()),
        hidden_painted=int((painted & ~seen).sum()),
        hidden_painted_away=int((painted & ~seen & ~truth.near_edge).sum()),
        called=int(called.sum()),
        called_hidden=int((called & hidden).sum()),
        called_near=int((called & is_near_hidden).sum()),
        hidden=int(hidden.sum()),
        hidden_near=int((hidden & is_near_called).sum()),
        errors=error[painted],
        errors_away=error[painted & ~truth.near_edge],
        errors_filled=error[painted & (fused.depth.origins == Origin.FILLED)],
        errors_beyond=error[ok & truth.beyond],
    )


def _quantile(values: Singles, share: float) -> float:
    return float(np.quantile(values, share)) if len(values) else math.nan
