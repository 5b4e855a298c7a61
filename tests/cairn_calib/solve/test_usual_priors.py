"""Default coefficients of a lens: all five, with what is usual of them; what the images leave open is reported."""

from dataclasses import replace

import numpy as np
from tests.fixtures.calib.simulated_views import LENSES, SPECTRA, views_of, world

from cairn_calib.diagnosis.examination import examine
from cairn_calib.rig.camera import Camera
from cairn_calib.rig.rig import Rig, Spectrum, mount_camera
from cairn_calib.solve.priors import USUAL_SIGMAS
from cairn_calib.solve.solution import Solution
from cairn_calib.solve.solve import solve_rig
from cairn_calib.solve.solve_plan import STATED, CameraPlan, SolvePlan, usual_plan
from cairn_calib.solve.solved_rig import solved_rig
from cairn_calib.verify.verification import transfer_pixels

TILTED: dict[str, Camera] = {
    name: lens.model_copy(update={"distortion": (*lens.distortion[:2], 8e-4, -6e-4, -0.03)})
    for name, lens in LENSES.items()
}
"""The head with lenses that are not quite straight, as all are."""


def solved(plan: SolvePlan) -> Solution:
    # A tenth of the usual noise, so that what is left is the model's error.
    views = views_of(world(12, seed=11, lenses=TILTED), seed=1, noise=0.1)
    return solve_rig(views, replace(plan, noise=STATED))


def worst_carried_px(rig: Rig) -> float:
    """Root mean square over the range camera's view, in the worst camera: predicted minus true pixels."""
    truth = world(1, lenses=TILTED)
    true = Rig(
        name="x",
        cameras={name: mount_camera(SPECTRA[name], TILTED[name], truth.T_rig_camera(name)) for name in truth.names},
    )
    rng = np.random.default_rng(2)
    pixels, range_m = rng.uniform([40, 30], [136, 114], (500, 2)), rng.uniform(1.1, 5.7, 500)
    worst = 0.0
    for name in ("left", "right", "thermal-left"):
        apart = transfer_pixels(rig, "tof", name, pixels, range_m) - transfer_pixels(true, "tof", name, pixels, range_m)
        worst = max(worst, float(np.sqrt(np.nanmean(apart**2))))
    return worst


def test_what_is_held_at_zero_and_is_not_is_paid_for_in_the_other_cameras() -> None:
    usual = usual_plan(SPECTRA)
    straight = {
        name: CameraPlan(spectrum=each.spectrum, free=("k1", "k2")) if each.spectrum is not Spectrum.COLOUR else each
        for name, each in usual.cameras.items()
    }
    one, other = (
        worst_carried_px(solved_rig(solved(plan), made_s=0.0)) for plan in (usual, replace(usual, cameras=straight))
    )
    assert one < 0.1
    assert other > 5 * one


def test_what_images_leave_to_the_priors_is_told_in_one_line_a_camera() -> None:
    few = solve_rig(views_of(world(4, seed=11, lenses=TILTED), seed=1, noise=2.0), usual_plan(SPECTRA))
    told = {each.camera: each for each in examine(few, solved_rig(few, made_s=0.0)).warnings if each.kind == "prior"}
    sigmas = few.sigmas()
    for camera in SPECTRA:
        open_ = [name for name, sigma in USUAL_SIGMAS.items() if sigmas[camera, name] / sigma > 0.7]
        assert [name for name in USUAL_SIGMAS if camera in told and f"{name} (" in told[camera].text] == open_
    assert any("k3 (0 +- 0.1)" in each.text for each in told.values())


def test_a_rational_lens_has_no_usual_k3() -> None:
    free = ("k1", "k2", "k3", "k4", "k5", "k6")
    views = views_of(world(8, seed=3, names=("left",)), seed=3)
    plan = SolvePlan(cameras={"left": CameraPlan(spectrum=Spectrum.COLOUR, free=free)}, gauge="left")
    named = {term[1] for prior in solve_rig(views, plan).adjustment.problem.priors for term in prior.terms}
    assert not named & {"p1", "p2", "k3"}
