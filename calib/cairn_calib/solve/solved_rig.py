"""Rig of a solution, as `rig.json` states it: cameras, poses, range bias, covariance, statistics and inputs."""

import importlib.metadata
from dataclasses import replace

import numpy as np

from cairn_calib.rig.calibration import Calibration, CameraStatistics, Statistics, covariance_from_matrix
from cairn_calib.rig.range_bias import RangeBias, bias_from_matrix
from cairn_calib.rig.rig import Rig, mount_camera
from cairn_calib.solve.corner_residuals import CornerData, corner_misses
from cairn_calib.solve.rig_state import warp_shape
from cairn_calib.solve.solution import Solution


def solved_rig(solution: Solution, *, made_s: float) -> Rig:
    """Rig of a solution made `made_s` seconds after 1970; its covariance is of the cameras, all else eliminated."""
    plan, state = solution.plan, solution.state
    cameras = {
        name: mount_camera(camera.spectrum, lens, T)
        for (name, camera), lens, T in zip(plan.cameras.items(), state.lenses, state.T_rig_camera, strict=True)
    }
    bias_at = solution.layout.bias_at
    if len(bias_at):
        owner = solution.layout.names[bias_at[0]][0]
        cameras[owner] = cameras[owner].model_copy(update={"range_bias": _range_bias(solution)})
    rows = [n for n, (owner, _) in enumerate(solution.layout.names) if owner in cameras and n not in bias_at]
    names = [solution.layout.names[n] for n in rows]
    calibration = Calibration(
        software=f"cairn {_version()}",
        made_s=made_s,
        gauge=plan.gauge,
        covariance=covariance_from_matrix(names, solution.covariance[np.ix_(rows, rows)]),
        statistics=statistics_of(solution),
        inputs=solution.views.inputs[:1000],
    )
    return Rig(name=plan.rig_name, cameras=cameras, calibration=calibration)


def _range_bias(solution: Solution) -> RangeBias | None:
    used, at = solution.ranges, solution.layout.bias_at
    if used is None or solution.spans is None:
        return None
    amplitudes = solution.spans.amplitudes
    count = len(used.terms.document_names)
    at = at[:count]
    bias = bias_from_matrix(
        replace(used.terms, nodes=None),
        solution.state.bias[:count],
        solution.covariance[np.ix_(at, at)],
        amplitudes=None if amplitudes is None else (amplitudes[0], amplitudes[2]),
    )
    return bias if solution.pattern is None else bias.model_copy(update={"pixel_offsets": solution.pattern.offsets})


def statistics_of(solution: Solution) -> Statistics:
    """Residuals of a solution: chi2 and its degrees of freedom, and each camera's noise and outliers."""
    cameras = {}
    board = (solution.views.board.points(), warp_shape(solution.views.board))
    names = list(solution.plan.cameras)
    count = 0
    for sensor in solution.adjustment.problem.sensors:
        count += int(sensor.kept.sum()) * sensor.axes
        if isinstance(sensor.data, CornerData):
            misses = corner_misses(sensor.data, solution.state, *board)[sensor.kept]
            cameras[names[sensor.data.camera]] = CameraStatistics(
                images=len(sensor.data.frames),
                points=int(sensor.there.sum()),
                outliers=int(sensor.there.sum() - sensor.kept.sum()),
                rms_px=float(np.sqrt(np.mean(misses**2))) if misses.size else 0.0,
                sigma_px=float(sensor.scale * sensor.data.sigma_px),
            )
    unknown = solution.layout.size + 6 * len(solution.state.T_rig_board)
    problem, scatter = solution.adjustment.problem, solution.scatter
    freedom = count + len(problem.priors) + sum(len(each.names) for each in problem.known) - unknown
    # By the noise of the corners alone, without the scatter of frames.
    chi2 = solution.adjustment.normal.cost + (scatter - 1) * sum(block.cost for block in solution.adjustment.blocks)
    return Statistics(
        chi2=chi2,
        degrees_of_freedom=max(freedom, 0),
        cameras=cameras,
        scatter=solution.scatter if solution.scatter > 1 else None,
    )


def _version() -> str:
    try:
        return importlib.metadata.version("cairn-robotics")
    except importlib.metadata.PackageNotFoundError:
        return "unknown"
