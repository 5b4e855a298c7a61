"""Views: one cell read as probability, colour and temperature, at any octree depth.

A view is for display, exports and robots that only drive; it is never merged. Each value is rounded to its nearest
step. At a depth above the voxels, a node has

    probability   the highest of the known voxels below: obstacles never vanish
    colour        the mean of all samples below; without a colour camera that of the class with the most votes below
    temperature   the mean of all samples below, and that of the hottest voxel below

A view has one scalar: the temperature, kelvin; for a page that shows a level the height of its surfaces, metres.
"""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Floats, Ints
from cairn_map.errors import BadInputError
from cairn_map.evidence.channels import HEIGHT_OFFSET, OTHER_GREY, Channel, ChannelKind, class_colours
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.grid import Geometry
from cairn_map.evidence.inverse_sensor_model import LOG_ODDS_STEP, SensorModel, log_odds
from cairn_map.evidence.voxels import reading_of_sums
from cairn_map.kernels.morton_kernels import deinterleave

PALE_PARTS = 2
"""Parts of grey in the colour of a class that leads by less than two votes, next to one of its own."""
HEIGHT_RESOLUTION_M = 0.001
"""Usual step of a level's heights in a view for a page, metres."""
LOG_ODDS_ZERO = 1 << 15
"""Added to log-odds in steps, so that they are 16 bits without a sign."""


class Extent(StrEnum):
    """Nodes that a view holds."""

    OCCUPIED = "occupied"
    KNOWN = "known"
    """Occupied and free nodes, which a robot needs to plan a path."""


class Chance(StrEnum):
    """Encoding of a probability."""

    BYTE = "byte"
    """p in 1/255."""
    LOG_ODDS = "log-odds"
    """ln(p / (1 - p)) in 0.001, 16 bits."""


class Colours(StrEnum):
    """Bits of red, green and blue."""

    NONE = "none"
    RGB_565 = "5-6-5"
    RGB_888 = "8-8-8"


TOPS = {Colours.NONE: (), Colours.RGB_565: (31, 63, 31), Colours.RGB_888: (255, 255, 255)}
"""Largest values of red, green and blue."""


@dataclass(frozen=True, slots=True)
class ViewStyle:
    """Selection of nodes and resolution of values of a view."""

    depth: int | None = None
    """Octree depth of the nodes, 1 to that of the cell; None: its voxels."""
    extent: Extent = Extent.OCCUPIED
    chance: Chance = Chance.BYTE
    colours: Colours = Colours.RGB_888
    scalar_step: float | None = 0.1
    """Step of the scalar, kelvin; of a level's view for a page metres; None: no scalar."""
    is_for_page: bool = False
    """True if a level has heights in place of temperatures, and classes that lead by less than two votes are paler. It
    is not written: who reads a view knows its map."""

    def __post_init__(self) -> None:
        step = self.scalar_step
        if step is not None and not 0.001 <= step <= 1000:
            raise BadInputError(
                "bad_style", f"scalar_step must be 0.001 to 1000 (kelvin or metres) or None, got {step}"
            )


FULL_STYLE = ViewStyle(chance=Chance.LOG_ODDS, scalar_step=0.01)
"""Style with all fields of the paper at full precision."""


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """N nodes of one cell at one depth, rising in number, as integers; properties read them as physical values."""

    depth: int
    style: ViewStyle
    nodes: npt.NDArray[np.uint32]
    """(N,) Morton numbers at `depth`."""
    chances: Ints
    """(N,) probabilities of occupancy, in the steps of `style.chance`."""
    coloured: Ints
    """(C,) rows of `nodes` that have a colour, rising."""
    rgb: Ints
    """(C, 3) colours, 0 to the largest value of the style; (C, 0) without colours."""
    scalar_rows: Ints
    """(W,) rows of `nodes` that have a temperature, or a level's surface, rising."""
    scalar_steps: Ints
    """(W, 1) means in steps, at the voxels' depth; else (W, 2) means, and the highest of the voxels; (0, 0) without. A
    level's are heights over the node's lower face."""

    def __len__(self) -> int:
        return len(self.nodes)

    @property
    def probability(self) -> Floats:
        """(N,) probability that the node is occupied."""
        if self.style.chance is Chance.BYTE:
            return self.chances / 255
        return np.asarray(1 / (1 + np.exp((LOG_ODDS_ZERO - self.chances) * LOG_ODDS_STEP)))

    @property
    def colour(self) -> npt.NDArray[np.uint8]:
        """(C, 3) colours, 8-bit sRGB."""
        scaled: npt.NDArray[np.uint8] = np.rint(self.rgb * 255 / np.array(TOPS[self.style.colours])).astype(np.uint8)
        return scaled

    def rows_of(self, nodes: npt.NDArray[np.uint32]) -> Ints:
        """(S,) row of each node of its depth; -1 where the view does not hold it."""
        return _rows_of(nodes, self.nodes)

    @property
    def scalars(self) -> Floats:
        """(W, 1 or 2) means, and of inner nodes the highest of the voxels; kelvin, or a level's heights, metres."""
        return self.scalar_steps.astype(np.float64) * (self.style.scalar_step or np.nan)


def view_of(evidence: Evidence, geometry: Geometry, model: SensorModel, style: ViewStyle) -> View:
    """View of one cell's evidence.

    Raises:
        BadInputError: kind `bad_style`: deeper than the cell.
    """
    # Nodes and their probabilities, from log-odds.
    depth = geometry.depth if style.depth is None else style.depth
    if not 1 <= depth <= geometry.depth:
        raise BadInputError("bad_style", f"a view's depth must be 1 to {geometry.depth}, got {depth}")
    up = geometry.depth - depth
    nodes, highest = _nodes(evidence, model, style.extent, up=3 * up)
    if style.chance is Chance.BYTE:
        chances = np.rint(255 / (1 + np.exp(-highest)))
    else:
        chances = np.rint(highest / LOG_ODDS_STEP) + LOG_ODDS_ZERO
    # The row of each sample's node; then the means of colours and temperatures by node.
    rows = _rows_of(evidence.voxels[evidence.sampled] >> np.uint32(3 * up), nodes)
    colour = next((c for c in geometry.channels if c.kind is ChannelKind.COLOUR), None)
    named = next((c for c in geometry.channels if c.kind is ChannelKind.CLASSES), None)
    coloured, rgb = np.empty(0, np.int64), np.empty((0, len(TOPS[style.colours])), np.int64)
    if colour is not None and style.colours is not Colours.NONE:
        coloured, rgb = _colours(evidence.samples[:, geometry.planes_of(colour.name)], colour, rows, style)
    elif named is not None and style.colours is not Colours.NONE:
        coloured, rgb = _class_colours(evidence.samples[:, geometry.planes_of(named.name)], named, rows, style)
    columns = 0 if style.scalar_step is None else 1 if depth == geometry.depth else 2
    scalar_rows, steps = np.empty(0, np.int64), np.empty((0, columns), np.int64)
    if style.scalar_step is not None:
        has_heights = geometry.is_flat and style.is_for_page
        scalar_rows, values = (_heights if has_heights else _kelvins)(evidence, geometry, rows, up)
        steps = np.rint(np.maximum(values[:, :columns], 0) / style.scalar_step).astype(np.int64)
    return View(depth, style, nodes, chances.astype(np.int64), coloured, rgb, scalar_rows, steps)


def _nodes(evidence: Evidence, model: SensorModel, extent: Extent, *, up: int) -> tuple[npt.NDArray[np.uint32], Floats]:
    """Nodes of the extent, and their highest log-odds; a node's number is a voxel's without its lowest `up` bits."""
    least = log_odds(model.p_occupied) if extent is Extent.OCCUPIED else -np.inf
    hits, misses = evidence.counts.T
    # Only counts make a voxel known, scalar readings alone do not. A voxel without hits is not above one half, in a
    # reading neither: its hits are those of all epochs, and what never rises from 0 never passes it.
    known = np.nonzero(hits != 0 if least >= 0 else (hits | misses) != 0)[0]
    nodes, odds = evidence.voxels[known], evidence.log_odds(model, rows=known)
    if up and len(nodes):
        # Voxels of one node are one run.
        nodes = nodes >> np.uint32(up)
        starts = np.nonzero(np.diff(nodes, prepend=~nodes[:1]))[0]
        nodes, odds = nodes[starts], np.maximum.reduceat(odds, starts)
    keep = odds > least
    return nodes[keep], odds[keep]


def _colours(sums: Ints, channel: Channel, rows_of_samples: Ints, style: ViewStyle) -> tuple[Ints, Ints]:
    rows, starts, mine = _by_node(sums, rows_of_samples)
    if not len(rows):
        return rows, np.empty((0, 3), np.int64)
    totals = np.add.reduceat(mine, starts, axis=0)
    mean = totals[:, :3] / totals[:, 3:] * channel.step + channel.zero
    return rows, np.rint(np.clip(mean, 0, 255) * np.array(TOPS[style.colours]) / 255).astype(np.int64)


def _class_colours(sums: Ints, channel: Channel, rows_of_samples: Ints, style: ViewStyle) -> tuple[Ints, Ints]:
    """Colours of the classes of a map without a colour camera: of all votes below a node the class with the most."""
    rows, starts, mine = _by_node(sums, rows_of_samples)
    if not len(rows):
        return rows, np.empty((0, 3), np.int64)
    reading = reading_of_sums(channel, np.add.reduceat(mine, starts, axis=0))
    rgb = class_colours(len(channel.classes))[reading.mean.astype(np.int64)].astype(np.float64)
    if style.is_for_page and reading.unsure is not None:
        rgb[reading.unsure] = (rgb[reading.unsure] + PALE_PARTS * OTHER_GREY) / (1 + PALE_PARTS)
    return rows, np.rint(rgb * np.array(TOPS[style.colours]) / 255).astype(np.int64)


def _kelvins(evidence: Evidence, geometry: Geometry, rows_of_samples: Ints, _up: int) -> tuple[Ints, Floats]:
    """Rows of nodes with temperatures, and (W, 2) their means and hottest voxels, kelvin."""
    thermal = next((c for c in geometry.channels if c.kind is ChannelKind.TEMPERATURE), None)
    if thermal is None:
        return np.empty(0, np.int64), np.empty((0, 2))
    rows, means = _means(evidence.samples[:, geometry.planes_of(thermal.name)], rows_of_samples)
    return rows, means * thermal.step + thermal.zero


def _heights(evidence: Evidence, geometry: Geometry, rows_of_samples: Ints, up: int) -> tuple[Ints, Floats]:
    """Rows of a level's nodes with surfaces, and (W, 2) mean and highest heights over the node's lower face, m."""
    sums = evidence.samples[:, geometry.planes_of(HEIGHT_OFFSET.name)]
    bins = deinterleave(evidence.voxels[evidence.sampled].astype(np.uint64))[:, 2] & ((1 << up) - 1)
    sums_um = sums[:, 0] * round(HEIGHT_OFFSET.step * 1000) + bins * geometry.voxel_height_um * sums[:, -1]
    rows, means = _means(np.stack([sums_um, sums[:, -1]], axis=1), rows_of_samples)
    return rows, means / 1e6


def _means(sums: Ints, rows_of_samples: Ints) -> tuple[Ints, Floats]:
    """Rows of nodes with values, and (W, 2) their means and their highest voxels' means, as sums have them."""
    rows, starts, mine = _by_node(sums, rows_of_samples)
    if not len(rows):
        return rows, np.empty((0, 2))
    totals = np.add.reduceat(mine, starts, axis=0)
    highest = np.maximum.reduceat(mine[:, 0] / mine[:, -1], starts)
    return rows, np.stack([totals[:, 0] / totals[:, -1], highest], axis=1)


def _rows_of(sampled: npt.NDArray[np.uint32], nodes: npt.NDArray[np.uint32]) -> Ints:
    """(S,) row of each sample's node in the view; -1 where the view does not hold the node."""
    rows = np.searchsorted(nodes, sampled)
    is_held = rows < len(nodes)
    is_held[is_held] = nodes[rows[is_held]] == sampled[is_held]
    return np.where(is_held, rows, -1)


def _by_node(sums: Ints, rows: Ints) -> tuple[Ints, Ints, Ints]:
    """Rows of the nodes with a channel's samples, the first sum of each node, and all sums that have a weight."""
    there = (sums[:, -1] > 0) & (rows >= 0)
    mine = rows[there]
    starts = np.nonzero(np.diff(mine, prepend=-1))[0]
    return mine[starts], starts, sums[there]


def evidence_of_view(view: View, geometry: Geometry, model: SensorModel) -> Evidence:
    """Reading of a cell's voxels that a view shows; a view knows no counts, so that each voxel has one.

    Args:
        view: of the cell's voxels, with log-odds.
        geometry: the map's.
        model: inverse sensor model of the view.

    Raises:
        BadInputError: kind `bad_style`: a view of coarser nodes, or of probabilities in bytes.
    """
    if view.depth != geometry.depth or view.style.chance is not Chance.LOG_ODDS:
        raise BadInputError("bad_style", "a reading is made of a view of voxels with log-odds")
    low, high = log_odds(model.p_min), log_odds(model.p_max)
    odds: Floats = np.clip((view.chances - LOG_ODDS_ZERO) * LOG_ODDS_STEP, low, high).astype(np.float64)
    is_occupied = odds > log_odds(model.p_occupied)
    samples = np.zeros((len(view), geometry.plane_count), np.int64)
    _put_samples(samples, view.coloured, view.colour.astype(np.float64), geometry, ChannelKind.COLOUR)
    _put_samples(samples, view.scalar_rows, view.scalars[:, :1], geometry, ChannelKind.TEMPERATURE)
    sampled = np.nonzero(samples.any(axis=1))[0]
    return Evidence(
        voxels=view.nodes,
        counts=np.stack([is_occupied, ~is_occupied], axis=1).astype(np.int32),
        sampled=sampled.astype(np.uint32),
        samples=samples[sampled],
        odds=odds,
    )


def _put_samples(samples: Ints, rows: Ints, values: Floats, geometry: Geometry, kind: ChannelKind) -> None:
    """Put one sample of these values into rows of the first channel of a kind."""
    channel = next((c for c in geometry.channels if c.kind is kind), None)
    if channel is None or not len(rows):
        return
    planes = geometry.planes_of(channel.name)
    steps = np.rint((values - channel.zero) / channel.step).astype(np.int64)
    # Sums, the square where the channel has one, and the weight.
    squares = [steps[:, :1] ** 2] if planes.stop - planes.start == steps.shape[1] + 2 else []
    samples[rows, planes] = np.concatenate([steps, *squares, np.ones((len(rows), 1), np.int64)], axis=1)
