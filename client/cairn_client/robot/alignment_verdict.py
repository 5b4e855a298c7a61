"""AlignmentVerdict on an alignment: its fit, the motions that nothing holds, and the places that would do as well."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from cairn_calib.rig.poses import Transform, inverse, transform_points
from cairn_map.arrays import Floats

FIT_MIN = 0.75
"""Share of the points in known space that must lie on surfaces; 0.98 in a simulated building, 0.91 in a real yard."""
KNOWN_MIN = 0.3
"""Share of the points that must lie in known space."""
RIVAL = 0.9
"""Another minimum is a rival from this share of the best one's worth on."""
APART_VOXELS = 3.0
"""Minima nearer than this, for the points' mean square, are one."""
HELD_MIN = 0.02
"""Least information of any motion, 1 being all points' normals along it: a room has 0.1, a bare corridor 0.002."""
SURFACES = 6
"""Surfaces with independent errors: a wall lies anywhere in its voxels with all its points, and a room has six."""


class AlignmentVerdict(StrEnum):
    """Usability of an alignment."""

    ACCEPTED = "accepted"
    AMBIGUOUS = "ambiguous"
    FAILED = "failed"


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """Place of a robot's frame on the map, its covariance, and the verdict on it."""

    verdict: AlignmentVerdict
    reason: str
    """Reason for the verdict, in words for people."""
    T_map_robot: Transform
    """(4, 4), metres: the best that was found, also where it is not accepted; the guess, if nothing was."""
    covariance: Floats
    """(6, 6) of the motion that is left, `T_true = T_map_robot exp(motion)`: [rotation (rad), translation (m)] in the
    robot's frame. Infinite where nothing is known. Voxels, not only noise, are in it."""
    fit: float = 0.0
    """Share, 0 to 1, of the points in known space that lie on surfaces, to one voxel."""
    known: float = 0.0
    """Share, 0 to 1, of the points that lie in known space."""

    @property
    def is_accepted(self) -> bool:
        """True if `T_map_robot` may be used."""
        return self.verdict is AlignmentVerdict.ACCEPTED


@dataclass(frozen=True, slots=True, eq=False)
class Minimum:
    """A place where the points fit better than at any near it."""

    T: Transform
    fit: float
    known: float

    @property
    def worth(self) -> float:
        """Share of all points that lie on surfaces."""
        return self.fit * self.known


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """Points on surfaces, M of them, at a minimum."""

    points: Floats
    """(M, 3) robot frame, metres."""
    normals: Floats
    """(M, 3) of the surfaces, robot frame, of length 1."""
    offsets_m: Floats
    """(M,) from the surfaces, along the normals."""


def failed(guess: Transform, reason: str) -> Alignment:
    """Alignment of scans for which nothing was found."""
    return Alignment(AlignmentVerdict.FAILED, reason, guess, np.diag(np.full(6, np.inf)))


def judged(best: Minimum, others: Sequence[Minimum], points: Floats, matches: Matches, *, edge_m: float) -> Alignment:
    """AlignmentVerdict on the best minimum among all others, for (N, 3) points in the robot's frame."""
    # What the matched surfaces say about the six motions, and the other minima that fit nearly as well.
    information, centre, scale_m = _information(matches)
    values, vectors = np.linalg.eigh(information)
    covariance = _covariance(information, centre, scale_m, matches, edge_m)
    found = Alignment(AlignmentVerdict.FAILED, "", best.T, covariance, best.fit, best.known)
    rivals = [
        other
        for other in others
        if other.worth >= RIVAL * best.worth and apart_m(best.T, other.T, points) > APART_VOXELS * edge_m
    ]
    # In this order: too little known, no fit, a motion that nothing holds, a rival; else it is accepted.
    if best.known < KNOWN_MIN:
        return replace(found, reason=f"only {best.known:.0%} of the points lie in known space")
    if best.fit < FIT_MIN:
        return replace(found, reason=f"only {best.fit:.0%} of the points in known space lie on surfaces")
    if values[0] < HELD_MIN:
        reason = f"nothing holds it {_motion_in_words(vectors[:, 0], best.T)}"
        return replace(found, verdict=AlignmentVerdict.AMBIGUOUS, reason=reason)
    if rivals:
        return replace(found, verdict=AlignmentVerdict.AMBIGUOUS, reason=_rivalry(best, rivals[0]))
    reason = f"{best.fit:.0%} of the points in known space lie on surfaces, and no other place fits as well"
    return replace(found, verdict=AlignmentVerdict.ACCEPTED, reason=reason)


def _information(matches: Matches) -> tuple[Floats, Floats, float]:
    """(6, 6) information of point-to-plane matches on [rotation, translation], their centre (3,) and its scale.

    Rotations are about the centre, and lengths in root mean square distances from it: then it has no units, and its
    eigenvalues compare (Zhang, Kaess and Singh 2016, On Degeneracy of Optimization-based State Estimation Problems).
    """
    centre = matches.points.mean(axis=0) if len(matches.points) else np.zeros(3)
    arms = matches.points - centre
    scale_m = max(float(np.sqrt((arms**2).sum(axis=1).mean())), 1e-6) if len(arms) else 1.0
    J = np.hstack([np.cross(arms / scale_m, matches.normals), matches.normals])
    return np.asarray(J.T @ J / max(len(J), 1)), centre, scale_m


def _covariance(information: Floats, centre: Floats, scale_m: float, matches: Matches, edge_m: float) -> Floats:
    """(6, 6) of what is left, in the robot's frame: each surface is off as its points are, and as voxels are coarse."""
    if not len(matches.points):
        return np.diag(np.full(6, np.inf))
    variance = float((matches.offsets_m**2).mean()) + edge_m**2 / 12
    centred = np.linalg.pinv(information, rcond=1e-9, hermitian=True) * variance / SURFACES
    # From rotations about the centre, in units of 1 / scale, to rotations about the origin: t = t_c - w x c.
    back = np.eye(6)
    back[:3, :3] /= scale_m
    back[3:, :3] = _cross_matrix(centre) / scale_m
    return np.asarray(back @ centred @ back.T)


def _cross_matrix(v: Floats) -> Floats:
    """(3, 3) with which `_cross_matrix(v) @ w` is v x w."""
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def apart_m(one: Transform, other: Transform, points: Floats) -> float:
    """Root mean square distance of the points at two places."""
    between = transform_points(one, points) - transform_points(other, points)
    return float(np.sqrt((between**2).sum(axis=1).mean()))


def _motion_in_words(motion: Floats, T_map_robot: Transform) -> str:
    """Words for the motion that is held least, in the map's frame."""
    turn, shift = np.linalg.norm(motion[:3]), np.linalg.norm(motion[3:])
    what, part = ("along", motion[3:]) if shift >= turn else ("around the axis", motion[:3])
    x, y, z = T_map_robot[:3, :3] @ part / max(turn, shift)
    return f"{what} ({x:.2f}, {y:.2f}, {z:.2f}) of the map; scan from where more than bare walls are in sight"


def _rivalry(best: Minimum, rival: Minimum) -> str:
    between = inverse(best.T) @ rival.T
    turn_rad = math.acos(min(1.0, max(-1.0, (float(np.trace(between[:3, :3])) - 1) / 2)))
    where = f"{np.linalg.norm(between[:3, 3]):.2f} m and {math.degrees(turn_rad):.0f} degrees away"
    return f"another place, {where}, fits as well: {rival.worth:.0%} of the points on surfaces, here {best.worth:.0%}"
