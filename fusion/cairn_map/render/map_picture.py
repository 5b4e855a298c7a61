"""One layer of a map from one pose: as values, and as a picture."""

import io
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Floats, Rgb
from cairn_map.errors import BadInputError
from cairn_map.queries.map_snapshot import MapSnapshot
from cairn_map.render.legend import with_legend, write_text_into
from cairn_map.render.map_render import Changes, MapRenderer, SurfaceImage
from cairn_map.render.pose_spread import PoseSpread, spread_picture, why_withheld
from cairn_map.render.render_picture import NOTHING, WARNING, ZERO_CELSIUS_K, Layer, Scale, painted

Values = npt.NDArray[np.floating]


@dataclass(frozen=True, slots=True, eq=False)
class Ages:
    """Times of the last changes, and the time now, in the same unit and from the same zero."""

    changes: Changes
    now: float


def layer_values(
    renderer: MapRenderer, snapshot: MapSnapshot, seen: SurfaceImage, layer: Layer, ages: Ages | None = None
) -> Values:
    """(H, W) values in the layer's unit: degrees Celsius, 1, metres, seconds (or that of `ages`); colours (H, W, 3).

    NaN where nothing is seen, and where the node seen has no such value.

    Raises:
        BadInputError: kinds `unknown_channel`: the map has no temperatures, or no colours; `not_level`: what level
            layers alone have.
    """
    match layer:
        case Layer.DEPTH:
            return seen.depth_m
        case Layer.PROBABILITY:
            return renderer.probability(snapshot, seen)
        case Layer.COLOUR:
            return renderer.colour(snapshot, seen)
        case Layer.TEMPERATURE:
            return renderer.temperature(snapshot, seen) - np.float32(ZERO_CELSIUS_K)
        case Layer.AGE:
            if ages is None:
                return np.full_like(seen.range_m, np.nan)
            # What claims to be later than now is as new as anything.
            return np.maximum(ages.now - renderer.changed(snapshot, seen, ages.changes), 0)
        case Layer.HEIGHT | Layer.SLOPE | Layer.STEP | Layer.DIFFICULTY:
            raise not_level_error(layer)


def not_level_error(layer: Layer) -> BadInputError:
    """The error of a layer of cubes that is asked for what level layers alone have, kind `not_level`."""
    return BadInputError(
        "not_level", f"a {layer} is drawn of a level layer: `cairn map layer add MAP NAME --kind level` makes one"
    )


def layer_picture(
    values: Values,
    seen: SurfaceImage,
    scale: Scale,
    spread: PoseSpread | None = None,
    *,
    shade: Floats | None = None,
) -> Rgb:
    """(H + legend, W, 3) sRGB: values painted, grey where a node without a value is seen, dark where nothing is.

    `shade` (H, W) multiplies the brightness of what is painted.

    With a pose's spread the picture is blurred as far as it may be off, or withheld where that is too far.
    """
    image = painted(values, scale)
    if shade is not None:
        image = np.rint(np.clip(image * np.nan_to_num(shade)[..., None], 0, 255)).astype(np.uint8)
    image[~seen.hit] = NOTHING
    if spread is not None:
        spread_px2 = spread.at(seen.sight, seen.range_m)
        why = why_withheld(spread_px2[seen.hit])
        if why is None:
            image = spread_picture(image, spread_px2)
        else:
            image[:] = NOTHING
            write_text_into(image, f"map withheld: {why}", (8, 8), WARNING)
    # A mark where the scale ends below the highest value that is seen.
    highest = float(np.nanmax(values, initial=-np.inf))
    is_beyond = scale.layer is not Layer.COLOUR and highest > scale.high
    return with_legend(image, scale, [f"highest: {highest:.4g}"] if is_beyond else [])


def arrays_of(
    values: Values, seen: SurfaceImage, layer: Layer, spread: PoseSpread | None = None
) -> dict[str, npt.NDArray[np.generic]]:
    """Arrays by name: `range_m`, `depth_m`, and the layer's values (`temperature_k`, `age_s`, `probability`, `colour`;
    of a level `height_m`, `slope_deg`, `step_m`, `difficulty`).

    With a pose's spread also `spread_px2`, (H, W, 3): the covariance xx, xy, yy of where each pixel's content appears.
    All float32, NaN where nothing is seen or nothing is known.
    """
    arrays: dict[str, npt.NDArray[np.generic]] = {"range_m": seen.range_m, "depth_m": seen.depth_m}
    if spread is not None:
        arrays["spread_px2"] = spread.at(seen.sight, seen.range_m)
    match layer:
        case Layer.TEMPERATURE:
            arrays["temperature_k"] = values.astype(np.float32) + np.float32(ZERO_CELSIUS_K)
        case Layer.AGE:
            arrays["age_s"] = values.astype(np.float32)
        case Layer.HEIGHT | Layer.STEP:
            arrays[f"{layer}_m"] = values.astype(np.float32)
        case Layer.SLOPE:
            arrays["slope_deg"] = values.astype(np.float32)
        case Layer.PROBABILITY | Layer.COLOUR | Layer.DIFFICULTY:
            arrays[str(layer)] = values.astype(np.float32)
    return arrays


def npz_of(arrays: dict[str, npt.NDArray[np.generic]]) -> bytes:
    """Arrays as the bytes of an `.npz` file."""
    out = io.BytesIO()
    np.savez_compressed(out, **arrays)  # type: ignore[arg-type]
    return out.getvalue()
