"""Thermal cameras of a report: the temperatures that their counts stand for, with standard deviations."""

from collections.abc import Sequence

import numpy as np

from cairn_calib.report.page import Table
from cairn_calib.rig.radiometry import ZERO_C_K, Radiometry
from cairn_calib.rig.rig import Rig, Spectrum


def radiometry_facts(rig: Rig) -> list[tuple[str, dict[str, object] | None]]:
    """Facts of each thermal camera, by name; None for a camera whose counts have no temperature."""
    return [
        (name, None if (known := rig[name].radiometry) is None else _facts(known))
        for name in rig.of_spectrum(Spectrum.THERMAL)
    ]


def radiometry_json(rig: Rig) -> dict[str, object]:
    """By thermal camera: its radiometry as in rig.json, or None: not radiometric."""
    return {
        name: None if (known := rig[name].radiometry) is None else known.model_dump(mode="json", exclude_none=True)
        for name in rig.of_spectrum(Spectrum.THERMAL)
    }


def _facts(known: Radiometry) -> dict[str, object]:
    low, high = (k - ZERO_C_K for k in known.range_k)
    lines = [f"{known.response.law} law, {low:.1f} to {high:.1f} °C; {known.source}"]
    if known.maps is not None:
        lines.append(f"pixels are levelled by maps of gain, offset and shading ({known.maps.name})")
    housing = known.housing
    if housing is not None:
        cold, warm = (k - ZERO_C_K for k in housing.range_k)
        sigma = float(np.sqrt(housing.covariance_row[3]))
        lines.append(
            f"housing: {housing.counts_per_k:.3g} ± {sigma:.2g} counts a kelvin, known from {cold:.1f} to {warm:.1f} °C"
        )
    return {"lines": lines, "sigmas": _sigma_table(known)}


def _sigma_table(known: Radiometry) -> Table:
    """Standard deviations of a black body's temperature, at five temperatures of the range."""
    kelvin = np.linspace(*known.range_k, 5)
    slope, J = known.response.slope(kelvin), known.response.by_parameters(kelvin)
    common = np.sqrt(np.maximum(np.einsum("ni,ij,nj->n", J, known.covariance, J), 0)) / slope
    common = np.hypot(common, known.accuracy_k)
    noise, pattern = known.noise_counts / slope, known.pattern_counts / slope
    rows: Sequence[tuple[str, np.ndarray[tuple[int, ...], np.dtype[np.float64]]]] = (
        ("the same for all pixels, K", common),
        ("pixel from image to image, K", noise),
        ("pixels' own pattern, K", pattern),
        ("together, K", np.sqrt(common**2 + noise**2 + pattern**2)),
    )
    head = ["sigma of a black body at", *(f"{k - ZERO_C_K:.0f} °C" for k in kelvin)]
    return Table(head, [[name, *(f"{v:.3f}" for v in values)] for name, values in rows])
