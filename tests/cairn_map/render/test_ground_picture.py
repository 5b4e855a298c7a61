"""A level as a camera sees it: the surfaces of its elevation, met as boxes are, without holes, in every layer."""

import numpy as np
import pytest
from tests.naive.evidence import interleave
from tests.naive.ground import nearest_span

from cairn_map.errors import BadInputError
from cairn_map.evidence.channels import HEIGHT_OFFSET
from cairn_map.evidence.evidence import packed_evidence
from cairn_map.evidence.evidence_map import EvidenceMap
from cairn_map.evidence.grid import CELL_LIMIT, CellKey, Geometry, cell_key, split_voxels, voxels_in_cell
from cairn_map.queries.map_snapshot import MapSnapshot, snapshot_of
from cairn_map.render import ground_picture
from cairn_map.render.camera_rays import look_at, pinhole
from cairn_map.render.ground_kernels import NO_ROW
from cairn_map.render.ground_picture import GroundColumns, check_layer, ground_columns, snapshot_ground
from cairn_map.render.map_picture import Ages, arrays_of, layer_picture
from cairn_map.render.render_picture import GROUND_LAYERS, NO_VALUE, NOTHING, SCALES, Layer

LEVEL = Geometry(voxel_edge_um=200_000, height_step_um=50_000, depth=4, channels=(HEIGHT_OFFSET,))
SIGHT = pinhole(40, 30, focal_px=24)
Surface = tuple[int, int, int, int]
"""Column x, y, height in steps of 5 mm, and hits without a vote in place of one: 0 for a surface, else an obstacle."""


def level_of(surfaces: list[Surface]) -> MapSnapshot:
    """Each surface seen by four scans."""
    cells: dict[CellKey, list[tuple[int, list[int]]]] = {}
    for x, y, height, is_obstacle in surfaces:
        voxel = np.array([[x, y, height // 10]], np.int64)
        (cell,), (place,) = split_voxels(voxel, LEVEL)
        row = [4, 0, 0, 0] if is_obstacle else [4, 0, 4 * (height % 10), 4]
        cells.setdefault(CellKey(int(cell)), []).append((int(place), row))
    whole = EvidenceMap(LEVEL)
    for key, rows in cells.items():
        sums = np.array([row for _, row in rows])
        places = np.array([place for place, _ in rows], np.uint32)
        whole.merge({key: packed_evidence(places, sums[:, :2], sums[:, 2:], LEVEL)})
    return snapshot_of(whole)


def rough_ground(seed: int, *, share: float = 1.0) -> list[Surface]:
    """One surface in most columns of four cells, which steps by up to 15 cm from one column to the next."""
    rng = np.random.default_rng(seed)
    return [
        (x, y, int(60 + 2 * x + y + rng.integers(0, 30)), 0)
        for x in range(-16, 16)
        for y in range(-16, 16)
        if rng.random() < share
    ]


def test_slopes_steps_and_difficulties_are_those_of_the_elevation() -> None:
    snapshot = level_of([*rough_ground(1, share=0.7), (3, 4, 220, 1), (-5, 2, 160, 1)])
    elevation, ground = snapshot.elevation(), snapshot_ground(snapshot)
    rows = np.flatnonzero(ground.columns.is_ground)
    centres = [(np.array(voxel[:2]) + 0.5) * 0.2 for voxel in (places_of(ground)[rows])]
    columns = np.rint((np.array(centres) - elevation.origin_m) / 0.2).astype(int)
    x, y = columns.T
    assert len(rows) == np.count_nonzero(np.isfinite(elevation.height_m)) > 600
    for found, wanted in (
        (ground.columns.tops, elevation.height_m),
        (ground.around[:, 0], elevation.slope_rad),
        (ground.around[:, 1], elevation.roughness_m),
        (ground.around[:, 2], elevation.step_m),
        (ground.around[:, 4], elevation.obstacle_m),
        (ground.difficulty, elevation.difficulty()),
    ):
        np.testing.assert_allclose(found[rows], wanted[y, x], atol=1e-9)


def places_of(ground: GroundColumns) -> np.ndarray[tuple[int, int], np.dtype[np.int64]]:
    """(R, 3) voxel numbers of a ground's spans."""
    return np.concatenate(
        [
            voxels_in_cell(ground.places[row : row + 1], ground.keys[slot], LEVEL)
            for row, slot in enumerate(ground.slots.tolist())
        ]
    )


@pytest.mark.parametrize(
    ("eye", "target"),
    [
        ((-5, -4, 3), (0, 0, 0.3)),
        ((0.1, 0.1, 6), (0.1, 0.1, 0)),
        ((0.3, -6, 0.4), (0.3, 2, 0.5)),
        ((0.05, 0, 0.2), (3, 0, 2)),
    ],
)
def test_a_ray_meets_the_nearest_of_all_spans(eye: tuple[float, ...], target: tuple[float, ...]) -> None:
    ground = snapshot_ground(level_of([*rough_ground(2, share=0.3), (2, 2, 400, 0), (2, 3, 400, 0), (1, 1, 300, 1)]))
    image = ground.seen(SIGHT, T := look_at(eye, target), range_max_m=7.0)
    spans = [
        ((int(x), int(y)), float(bottom), float(top))
        for (x, y, _), bottom, top in zip(places_of(ground), ground.columns.bottoms, ground.columns.tops, strict=True)
    ]
    rays = SIGHT.rays.reshape(-1, 3) @ T[:3, :3].T
    some = np.random.default_rng(3).choice(len(rays), 150, replace=False)
    for n in some.tolist():
        range_m, _ = nearest_span(spans, 0.2, T[:3, 3], rays[n], 7.0)
        assert float(image.seen.range_m.reshape(-1)[n]) == pytest.approx(range_m, abs=1e-5, nan_ok=True)
    assert ((image.rows == NO_ROW) == np.isnan(image.seen.range_m)).all() and image.seen.hit.any()


def test_ground_that_is_known_everywhere_has_no_hole_and_a_bridge_stays_over_its_road() -> None:
    ground = snapshot_ground(level_of([*rough_ground(4), *((x, y, 600, 0) for x in range(4) for y in range(-16, 16))]))
    above = ground.seen(SIGHT, look_at((1.0, 0.9, 5.0), (0.2, 0.3, 0.0)), range_max_m=20.0)
    assert above.seen.hit[10:20, 15:25].all()
    heights = above.values(Layer.HEIGHT)
    assert np.isclose(heights, 3.0).any() and (heights < 1.5).any()
    below = ground.seen(SIGHT, look_at((0.4, -3.0, 1.6), (0.4, 2.0, 0.6)), range_max_m=20.0)
    assert below.values(Layer.HEIGHT)[18:].max() < 1.5  # the road, from below the bridge
    assert np.isclose(below.values(Layer.HEIGHT)[0, 18:22], 3.0).all()  # its deck


def test_every_layer_of_a_level_is_a_picture_and_others_are_refused() -> None:
    snapshot = level_of([*rough_ground(5, share=0.9), (0, 0, 260, 1)])
    image = snapshot_ground(snapshot).seen(SIGHT, look_at((-3, -3, 4), (1, 1, 0)), range_max_m=20.0)
    times = {key: np.full(8 ** (LEVEL.depth - 2), 5.0) for key in image.ground.keys}
    for layer in (*GROUND_LAYERS, Layer.DEPTH, Layer.PROBABILITY, Layer.AGE):
        values = image.values(layer, Ages(times, now=7.0))
        assert np.isnan(values[~image.seen.hit]).all()
        picture = layer_picture(values, image.seen, SCALES[layer], shade=image.shade)[: SIGHT.height]
        assert (picture[~image.seen.hit] == NOTHING).all()
        assert len(np.unique(picture[image.seen.hit & ~np.isnan(values)], axis=0)) > 3
        assert arrays_of(values, image.seen, layer)
    assert (image.values(Layer.AGE, Ages(times, now=7.0))[image.seen.hit] == 2.0).all()
    assert np.isnan(image.values(Layer.AGE)).all()
    block = image.rows == np.flatnonzero(~image.ground.columns.is_ground)[0]
    slopes = layer_picture(image.values(Layer.SLOPE), image.seen, SCALES[Layer.SLOPE], shade=image.shade)
    assert block.any() and (slopes[: SIGHT.height][block] == NO_VALUE).all()
    for layer in (Layer.TEMPERATURE, Layer.COLOUR):
        with pytest.raises(BadInputError) as refused:
            image.values(layer)
        assert refused.value.kind == "unknown_channel"
    for layer in GROUND_LAYERS:
        with pytest.raises(BadInputError) as refused:
            check_layer(Geometry(), layer)
        assert refused.value.kind == "not_level"


def test_an_empty_level_shows_nothing_and_one_that_is_too_large_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    nothing = ground_columns({}, LEVEL).seen(SIGHT, look_at((0, 0, 1), (1, 0, 0)), range_max_m=5.0)
    assert not nothing.seen.hit.any() and np.isnan(nothing.values(Layer.SLOPE)).all()
    for pose, range_m, kind in ((np.zeros((4, 4)), 5.0, "bad_pose"), (np.eye(4), np.nan, "bad_range")):
        with pytest.raises(BadInputError) as refused:
            nothing.ground.seen(SIGHT, pose, range_max_m=range_m)
        assert refused.value.kind == kind
    far = {
        cell_key(place): ground_picture.ground_cell(
            packed_evidence(
                np.array([interleave(0, 0, 0)], np.uint32), np.ones((1, 2), np.int64), np.array([[0, 1]]), LEVEL
            ),
            cell_key(place),
            LEVEL,
            snapshot_of(EvidenceMap(LEVEL)).model,
        )
        for place in ((-CELL_LIMIT, -CELL_LIMIT, 0), (0, 0, 0), (CELL_LIMIT - 1, CELL_LIMIT - 1, 0))
    }
    with pytest.raises(BadInputError, match="the cells in sight span 2097152 x 2097152, ") as refused:
        ground_columns(far, LEVEL)
    assert refused.value.kind == "too_large"
    monkeypatch.setattr(ground_picture, "SPANS_MAX", 10)
    with pytest.raises(BadInputError) as refused:
        snapshot_ground(level_of(rough_ground(6)))
    assert refused.value.kind == "too_large"
