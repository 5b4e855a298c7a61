"""The examination of a calibration as one JSON document, for programs; the HTML report says the same to people.

    {"format": "cairn-calibration-report", "version": 1, "rig": "orpheus-head", "gauge": "tof",
     "parameters": [{"owner": "tof", "name": "fx", "unit": "px", "value": 130.1, "sigma": 0.11}, ...],
     "cameras": {"tof": {"tilt_deg": 54.1, "images": [{"frame": "000003", "rms_px": 0.1, "outliers": 0}, ...], ...}},
     "ranges": {"camera": "tof", "nearest_m": 1.1, "harmonics": [4], "pixels": {"pattern_sigma_m": 0.006, ...}, ...},
     "halves": {...}, "influences": [...], "weak_modes": [...], "next_images": [...],
     "radiometry": {"thermal": null}, "verdict": {"usable": true, "text": "usable: ..."}, "known": [...],
     "warnings": [{"rank": "note", "kind": "edge", ...}, ...]}

An owner "" is the board: warp_x and warp_y in metres, scale of its pitch. Parameters of a pose are errors: value 0.
Radiometry is of every thermal camera, as in rig.json; null: not radiometric.
"""

import json
from dataclasses import asdict

import numpy as np

from cairn_calib.diagnosis.examination import Examination
from cairn_calib.diagnosis.probe_points import RANGES_M
from cairn_calib.diagnosis.view_statistics import view_residuals
from cairn_calib.diagnosis.world_uncertainty import sigma_map
from cairn_calib.report.range_report import ranges_json
from cairn_calib.report.report_radiometry import radiometry_json
from cairn_calib.report.validity import validity
from cairn_calib.rig.calibration import unit_of
from cairn_calib.solve.known_fit import KnownFit
from cairn_calib.solve.rig_state import WARP

FORMAT = "cairn-calibration-report"
MAP_COLUMNS = 8


def examination_json(seen: Examination) -> bytes:
    """The document, UTF-8; infinite numbers are null."""
    solution = seen.solution
    values, sigmas = solution.values(), solution.sigmas()
    document = {
        "format": FORMAT,
        "version": 1,
        "rig": seen.rig.name,
        "gauge": solution.plan.gauge,
        "statistics": None
        if seen.rig.calibration is None or seen.rig.calibration.statistics is None
        else seen.rig.calibration.statistics.model_dump(),
        "parameters": [
            {
                "owner": owner,
                "name": name,
                "unit": _unit(name),
                "value": values[owner, name],
                "sigma": sigmas[owner, name],
            }
            for owner, name in solution.layout.names
        ],
        "cameras": {name: _camera(seen, name) for name in solution.plan.cameras},
        "ranges": ranges_json(solution),
        "halves": None if seen.halves is None else asdict(seen.halves),
        "influences": [asdict(each) for each in seen.influences],
        "weak_modes": [asdict(each) for each in seen.modes],
        "next_images": [{**asdict(each), "text": str(each)} for each in seen.next_images],
        "radiometry": radiometry_json(seen.rig),
        "verdict": {"usable": seen.verdict.is_usable, "text": str(seen.verdict)},
        "known": [_known(each) for each in solution.known],
        "warnings": [{**asdict(each), "rank": each.rank.name.lower()} for each in seen.warnings],
    }
    return json.dumps(_finite(document), indent=1, allow_nan=False).encode() + b"\n"


def _known(fit: KnownFit) -> dict[str, object]:
    return {
        "camera": fit.known.camera,
        "source": fit.known.source,
        "names": list(fit.known.names),
        "stated": fit.known.values.tolist(),
        "stated_sigmas": np.sqrt(np.diag(fit.known.covariance)).tolist(),
        "solved": fit.values.tolist(),
        "sigmas_off": fit.sigmas_off.tolist(),
        "together_off": fit.together,
        "enlarged": fit.scale,
    }


def _camera(seen: Examination, name: str) -> dict[str, object]:
    covered = next(each for each in seen.coverage if each.camera == name)
    residuals = [each for each in view_residuals(seen.solution) if each.camera == name]
    images = [
        {"frame": each.frame, "image": each.image, "rms_px": each.rms_px, "outliers": each.outliers}
        for each in residuals
    ]
    maps = {
        f"{far:g} m": np.round(sigma_map(seen.solution, seen.rig, name, far, columns=MAP_COLUMNS), 4).tolist()
        for far in RANGES_M
    }
    return {
        "tilt_deg": covered.tilt_deg,
        "lean_deg": covered.lean_deg,
        "nearest_m": covered.nearest_m,
        "farthest_m": covered.farthest_m,
        "radius_share": covered.radius_share,
        "corners_by_part": covered.counts.tolist(),
        "sigma_px_by_part": maps,
        "validity": validity(seen, name, residuals).to_json(),
        "images": images,
    }


def _unit(name: str) -> str:
    """Unit of a free parameter, by its name: those of warp and range bias are metres."""
    return "m" if name.endswith("_m") or name in WARP else unit_of(name)


def _finite(value: object) -> object:
    """The same without numbers that JSON has no word for."""
    if isinstance(value, dict):
        return {key: _finite(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(each) for each in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value
