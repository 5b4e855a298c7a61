"""Views: what they state is the nearest step of what the evidence says, and comes back from bytes as it went in."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.fixtures.map.made import GEOMETRIES, KEY, MIDDLE, SMALL, as_dict, random_evidence

from cairn_map.codec.view_code import decode_view, encode_view
from cairn_map.errors import BadInputError, CairnError
from cairn_map.evidence.channels import ChannelKind
from cairn_map.evidence.evidence import Evidence, empty_evidence
from cairn_map.evidence.grid import Geometry
from cairn_map.evidence.inverse_sensor_model import SensorModel, log_odds
from cairn_map.evidence.view import FULL_STYLE, LOG_ODDS_ZERO, TOPS, Chance, Colours, Extent, View, ViewStyle, view_of

MODEL = SensorModel()
COLUMNS = ("nodes", "chances", "coloured", "rgb", "scalar_rows", "scalar_steps")
STYLES = st.builds(
    ViewStyle,
    depth=st.one_of(st.none(), st.integers(1, 3)),
    extent=st.sampled_from(Extent),
    chance=st.sampled_from(Chance),
    colours=st.sampled_from(Colours),
    scalar_step=st.sampled_from([None, 0.01, 0.1, 5.0]),
)


def naive_nodes(
    evidence: Evidence, geometry: Geometry, style: ViewStyle
) -> dict[int, list[tuple[float, tuple[int, ...]]]]:
    """Log-odds (minus infinity if unknown) and sums of the voxels of each node that a view stores."""
    low, high = log_odds(MODEL.p_min), log_odds(MODEL.p_max)
    depth = geometry.depth if style.depth is None else style.depth
    nodes: dict[int, list[tuple[float, tuple[int, ...]]]] = {}
    for place, (hits, misses, sums) in as_dict(evidence).items():
        odds = -math.inf
        if hits or misses:
            odds = min(max(hits * log_odds(MODEL.p_hit) + misses * log_odds(MODEL.p_miss), low), high)
        nodes.setdefault(place >> 3 * (geometry.depth - depth), []).append((odds, sums))
    least = 0 if style.extent is Extent.OCCUPIED else -math.inf
    return {node: voxels for node, voxels in nodes.items() if max(odds for odds, _ in voxels) > least}


@given(st.integers(0, 1000), st.sampled_from(GEOMETRIES), STYLES)
def test_a_view_comes_back_as_it_went_in(seed: int, geometry: Geometry, style: ViewStyle) -> None:
    evidence = random_evidence(seed, geometry, voxels=200)
    decoded = decode_view(encode_view(KEY, evidence, geometry, MODEL, style=style))
    assert (decoded.key, decoded.voxel_edge_um, decoded.cell_depth) == (KEY, geometry.voxel_edge_um, geometry.depth)
    seen = view_of(evidence, geometry, MODEL, style)
    assert decoded.view.depth == seen.depth
    for name in COLUMNS:
        assert np.array_equal(getattr(decoded.view, name), getattr(seen, name)), name


@given(st.integers(0, 1000), st.sampled_from(GEOMETRIES), STYLES)
def test_nodes_hold_the_highest_probability_mean_colours_and_the_hottest_voxel(
    seed: int, geometry: Geometry, style: ViewStyle
) -> None:
    evidence = random_evidence(seed, geometry, voxels=200)
    view, nodes = view_of(evidence, geometry, MODEL, style), naive_nodes(evidence, geometry, style)
    assert view.nodes.tolist() == sorted(nodes)
    for node, p, code in zip(view.nodes.tolist(), view.probability, view.chances.tolist(), strict=True):
        odds = max(odds for odds, _ in nodes[node])
        if style.chance is Chance.BYTE:
            assert abs(p - 1 / (1 + math.exp(-odds))) <= 0.5 / 255 + 1e-12
        else:
            assert abs((code - LOG_ODDS_ZERO) * 0.001 - odds) <= 0.0005 + 1e-12
    check_colours(view, nodes, geometry)
    check_temperatures(view, nodes, geometry)


def check_colours(view: View, nodes: dict[int, list[tuple[float, tuple[int, ...]]]], geometry: Geometry) -> None:
    channel = next((c for c in geometry.channels if c.kind is ChannelKind.COLOUR), None)
    if channel is None or view.style.colours is Colours.NONE:
        assert not len(view.coloured)
        return
    planes = geometry.planes_of(channel.name)
    expected = {}
    for node, voxels in nodes.items():
        sums = np.sum([sums[planes] for _, sums in voxels], axis=0)
        if sums[-1]:
            expected[node] = np.clip(sums[:3] / sums[-1], 0, 255)
    assert view.nodes[view.coloured].tolist() == sorted(expected)
    half = 127.5 / np.array(TOPS[view.style.colours])
    for node, rgb in zip(view.nodes[view.coloured].tolist(), view.rgb, strict=True):
        stated = rgb * 255 / np.array(TOPS[view.style.colours])
        assert (np.abs(stated - expected[node]) <= half + 1e-9).all()


def check_temperatures(view: View, nodes: dict[int, list[tuple[float, tuple[int, ...]]]], geometry: Geometry) -> None:
    channel = next((c for c in geometry.channels if c.kind is ChannelKind.TEMPERATURE), None)
    step = view.style.scalar_step
    if channel is None or step is None:
        assert not len(view.scalar_rows)
        return
    planes = geometry.planes_of(channel.name)
    expected = {}
    for node, voxels in nodes.items():
        rows = [sums[planes] for _, sums in voxels if sums[planes][-1]]
        if rows:
            mean = sum(r[0] for r in rows) / sum(r[-1] for r in rows)
            expected[node] = [mean * channel.step, max(r[0] / r[-1] for r in rows) * channel.step]
    assert view.nodes[view.scalar_rows].tolist() == sorted(expected)
    for node, kelvin in zip(view.nodes[view.scalar_rows].tolist(), view.scalars, strict=True):
        assert np.abs(kelvin - expected[node][: len(kelvin)]).max() <= step / 2 + 1e-9


def test_an_empty_cell_has_a_view_without_nodes() -> None:
    for geometry in GEOMETRIES:
        for style in (ViewStyle(), ViewStyle(depth=1, extent=Extent.KNOWN), FULL_STYLE):
            data = encode_view(KEY, empty_evidence(geometry), geometry, MODEL, style=style)
            assert len(decode_view(data).view) == 0
            assert len(data) < 90


def test_a_style_that_no_cell_has_is_refused() -> None:
    evidence = random_evidence(1, SMALL)
    for depth in (0, 4):
        with pytest.raises(BadInputError, match="depth must be 1 to 3"):
            encode_view(KEY, evidence, SMALL, MODEL, style=ViewStyle(depth=depth))
    for step in (0.0, -1.0, float("nan"), 1e9):
        with pytest.raises(BadInputError, match="kelvin"):
            ViewStyle(scalar_step=step)


SOUND = encode_view(KEY, random_evidence(3, MIDDLE, voxels=60), MIDDLE, MODEL, style=ViewStyle(extent=Extent.KNOWN))


def survives(data: bytes) -> None:
    try:
        view = decode_view(data, nodes_max=1 << 16).view
    except CairnError:
        return
    assert (np.diff(view.nodes.astype(np.int64)) > 0).all()
    assert view.probability.shape == (len(view),)
    assert (view.coloured < len(view)).all()
    assert (view.scalar_rows < len(view)).all()


def test_cut_views_are_refused() -> None:
    for size in range(len(SOUND)):
        with pytest.raises(CairnError):
            decode_view(SOUND[:size])
    with pytest.raises(CairnError):
        decode_view(SOUND + b"\0")


@pytest.mark.slow
def test_flipped_bits_raise_or_say_something_else() -> None:
    for at in range(len(SOUND)):
        for bit in range(8):
            survives(SOUND[:at] + bytes([SOUND[at] ^ 1 << bit]) + SOUND[at + 1 :])


@given(st.binary(max_size=300))
def test_random_bytes_are_refused(tail: bytes) -> None:
    survives(tail)
    survives(SOUND[:60] + tail)


def test_more_nodes_than_wanted_are_refused_before_they_are_made() -> None:
    with pytest.raises(BadInputError, match="at most 10"):
        decode_view(SOUND, nodes_max=10)
