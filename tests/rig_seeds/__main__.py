"""Whether a calibration's uncertainties are true: the same five-camera rig, calibrated with many noises.

    $ python -m tests.rig_seeds --seeds 200        # part of `make soak`, about two minutes
    within 3 sigma        99.68 %   at least 99 %
    chi2 in its 99 % interval  98.5 %   of 200 seeds, at least 97 %
    spread over stated sigma  1.006   median of 69, within 5 %; 0.893 to 1.121, each within 20 %

Truth is drawn anew where the solve assumes what it is, give or take (the board's pitch; p1, p2 and k3 of every lens);
poses stay. Exit code 1 if a law fails.
"""

import argparse
import sys
from dataclasses import replace

import numpy as np
from tests.fixtures.calib.simulated_views import LENSES, SPECTRA, errors_of, views_of, world

from cairn_calib.rig.camera import Camera
from cairn_calib.solve.priors import USUAL_SIGMAS
from cairn_calib.solve.solve import solve_rig
from cairn_calib.solve.solve_plan import PITCH_SIGMA, STATED, usual_plan
from cairn_calib.solve.solved_rig import statistics_of

FRAMES = 12
NORMAL_99 = 2.576
INSIDE_MIN, CHI2_MIN = 0.99, 0.97
MEDIAN_OFF, EACH_OFF = 0.05, 0.2


def main() -> int:
    """Solve, compare, print."""
    parser = argparse.ArgumentParser("python -m tests.rig_seeds", description=__doc__.partition("\n")[0])
    parser.add_argument("--seeds", type=int, default=200)
    seeds = parser.parse_args().seeds
    plan = replace(usual_plan(SPECTRA), noise=STATED)
    errors, stated, chi2 = [], [], []
    for seed in range(seeds):
        scale = 1 + PITCH_SIGMA * float(np.random.default_rng([seed, 3]).normal())
        truth = world(FRAMES, seed=11, warp_m=(0.0005, -0.0003), scale=scale, lenses=lenses_of(seed))
        solution = solve_rig(views_of(truth, seed=seed), plan)
        found, sigmas = errors_of(solution, truth), solution.sigmas()
        errors.append([found[name] for name in solution.layout.names])
        stated.append([sigmas[name] for name in solution.layout.names])
        fit = statistics_of(solution)
        # Wilson and Hilferty: the cube root of chi2 / n is nearly normal.
        n = fit.degrees_of_freedom
        chi2.append(((fit.chi2 / n) ** (1 / 3) - (1 - 2 / (9 * n))) / np.sqrt(2 / (9 * n)))
    pulls = np.array(errors) / np.array(stated)
    inside, fits = float(np.mean(np.abs(pulls) < 3)), float(np.mean(np.abs(chi2) < NORMAL_99))
    ratios = np.std(errors, axis=0) / np.median(stated, axis=0)
    middle = float(np.median(ratios))
    sys.stdout.write(f"within 3 sigma             {inside:.2%}   at least {INSIDE_MIN:.0%}\n")
    sys.stdout.write(f"chi2 in its 99 % interval  {fits:.1%}   of {seeds} seeds, at least {CHI2_MIN:.0%}\n")
    sys.stdout.write(
        f"spread over stated sigma   {middle:.3f}   median of {len(ratios)}, within {MEDIAN_OFF:.0%}; "
        f"{ratios.min():.3f} to {ratios.max():.3f}, each within {EACH_OFF:.0%}\n"
    )
    true = inside >= INSIDE_MIN and fits >= CHI2_MIN and abs(middle - 1) <= MEDIAN_OFF
    return 0 if true and np.abs(ratios - 1).max() <= EACH_OFF else 1


def lenses_of(seed: int) -> dict[str, Camera]:
    """The head's lenses with tangential parts and k3 as uncertain as they are assumed to be."""
    rng, lenses = np.random.default_rng([seed, 4]), {}
    for name, lens in LENSES.items():
        k1, k2, *_ = lens.distortion
        p1, p2, k3 = (float(v) for v in rng.normal(size=3) * [USUAL_SIGMAS[each] for each in ("p1", "p2", "k3")])
        lenses[name] = lens.model_copy(update={"distortion": (k1, k2, p1, p2, k3)})
    return lenses


if __name__ == "__main__":
    sys.exit(main())
