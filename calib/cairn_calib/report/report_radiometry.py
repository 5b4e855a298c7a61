"""What a report says of thermal cameras: what their counts mean, and how certain that is; or that nobody knows."""

from collections.abc import Sequence
from html import escape

import numpy as np

from cairn_calib.report.solve_tables import table
from cairn_calib.rig.radiometry import ZERO_C_K, Radiometry
from cairn_calib.rig.rig import Rig, Spectrum

NOT_RADIOMETRIC = (
    "<b>not radiometric</b>: no reference was measured, so its counts have no temperature; black bodies would give "
    "them one (cairn calib thermal fit)"
)


def radiometry_section(rig: Rig) -> str:
    """HTML; nothing for a rig without thermal cameras."""
    names = list(rig.of_spectrum(Spectrum.THERMAL))
    if not names:
        return ""
    told = "".join(
        f"<p>{escape(name)}: {NOT_RADIOMETRIC}.</p>" if (known := rig[name].radiometry) is None else _known(name, known)
        for name in names
    )
    return f"<h2>Radiometry</h2>{told}"


def radiometry_json(rig: Rig) -> dict[str, object]:
    """By thermal camera: its radiometry as in rig.json, or None: not radiometric."""
    return {
        name: None if (known := rig[name].radiometry) is None else known.model_dump(mode="json", exclude_none=True)
        for name in rig.of_spectrum(Spectrum.THERMAL)
    }


def _known(name: str, known: Radiometry) -> str:
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
    told = "".join(f"<li>{escape(line)}</li>" for line in lines)
    return f"<h3>{escape(name)}</h3><ul>{told}</ul>{_sigma_table(known)}"


def _sigma_table(known: Radiometry) -> str:
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
    return table(head, [[name, *(f"{v:.3f}" for v in values)] for name, values in rows])
