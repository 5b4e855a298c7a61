"""How certain a pose is, on a command line: `--sigma M,DEG` for all axes alike, or `--covariance` in full."""

import argparse

import numpy as np

from cairn_map.render.pose_spread import PoseSpread


def add_spread_arguments(options: argparse.ArgumentParser) -> None:
    """Add `--sigma` and `--covariance`, of which one at most is given."""
    certain = options.add_mutually_exclusive_group()
    certain.add_argument("--sigma", type=_sigma, default=(0.0, 0.0), metavar="M,DEG", help="of the pose (0,0)")
    certain.add_argument("--covariance", type=_numbers, metavar="N,N,...", help="of the pose, 21 numbers: see above")


def spread_of(args: argparse.Namespace) -> PoseSpread:
    """How certain a pose is, as `--covariance` or `--sigma` says.

    Raises:
        BadInputError: kind `bad_pose`: it is no covariance.
    """
    if args.covariance is not None:
        return PoseSpread.of_lower(args.covariance)
    return PoseSpread.of_sigmas(args.sigma[0], float(np.radians(args.sigma[1])))


def _sigma(text: str) -> tuple[float, float]:
    try:
        metres, degrees = (float(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected METRES,DEGREES, such as 0.02,1; got {text!r}") from None
    return metres, degrees


def _numbers(text: str) -> tuple[float, ...]:
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected numbers with commas between, got {text!r}") from None
