"""Means of pixels as samples: the kernel against plain Python, and values that no sample can hold."""

import numpy as np
import pytest

from cairn_fusion.mapping.sample_kernels import write_means_into
from cairn_map.evidence.channels import COLOUR, SAMPLE_MAX, TEMPERATURE, Channel
from cairn_map.evidence.grid import Geometry

GEOMETRY = Geometry(voxel_edge_um=50_000, depth=3, channels=(COLOUR, TEMPERATURE))


def naive_means(sums: list[list[int]], channel: Channel, totals: list[list[float]], counts: list[int]) -> None:
    """One sample of weight 1 to each voxel that was seen and has none: `Channel.quantise` of the mean."""
    planes = GEOMETRY.planes_of(channel.name)
    for row, total, count in zip(sums, totals, counts, strict=True):
        if count and not row[planes.stop - 1]:
            values = channel.quantise(np.array([value / count for value in total])).tolist()
            squares = [values[0] ** 2] if channel is TEMPERATURE else []
            row[planes] = [*values, *squares, 1]


@pytest.mark.parametrize("channel", [COLOUR, TEMPERATURE])
@pytest.mark.parametrize("seed", range(4))
def test_means_agree_with_their_slow_twin(channel: Channel, seed: int) -> None:
    rng = np.random.default_rng(seed)
    counts = rng.integers(0, 4, 40)
    totals = rng.integers(0, 510, (40, channel.value_count)) / 2 * np.maximum(counts, 1)[:, None]
    sums = np.zeros((40, GEOMETRY.plane_count), np.int64)
    planes = GEOMETRY.planes_of(channel.name)
    sums[::5, planes] = 7  # another camera spoke for these
    expected = sums.tolist()
    naive_means(expected, channel, totals.tolist(), counts.tolist())
    is_squared = channel is TEMPERATURE
    ends = (planes.start, planes.stop - 1)
    assert write_means_into(sums, *ends, totals, counts, channel.zero, channel.step, is_squared)  # type: ignore[call-arg]
    assert sums.tolist() == expected
    assert (sums[:, planes.stop - 1] == 1).sum() > 10


@pytest.mark.parametrize("value", [-1.0, SAMPLE_MAX + 1.0, np.nan, np.inf])
def test_a_mean_that_no_sample_can_hold_is_told(value: float) -> None:
    sums, totals, counts = np.zeros((1, 8), np.int64), np.array([[value]]), np.ones(1, np.int64)
    assert not write_means_into(sums, 0, 1, totals, counts, 0.0, 1.0, False)
