"""Published poses that are no exact rotations: the nearest rotations are taken, and the changes are counted.

deviation     largest entry of R^T R - I, or of a quaternion the difference of its length from 1
up to 1e-6    numbers of single precision: not worth a word
up to 1e-2    rounded to three digits, or the product of many matrices: the nearest rotation is taken
beyond        a scale, a mirror, a typing error: refused
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cairn_calib.rig.poses import Transform, check_transform, rotation_deviation
from cairn_map.errors import BadInputError

EXACT, ROUNDED = 1e-6, 1e-2


@dataclass(slots=True)
class PoseRounding:
    """Poses of one source so far, and how far they were from rotations."""

    poses: int = 0
    rounded: int = 0
    """Count of those that were changed by more than `EXACT`."""
    largest: float = 0.0
    """Largest deviation."""
    where: str = ""
    """Place of the pose with the largest deviation: its file, or file and line."""

    def transform(self, values: npt.ArrayLike, *, name: str) -> Transform:
        """(4, 4) pose of a matrix whose rotation may be rounded; `name` is its place.

        Raises:
            BadInputError: kind `bad_transform`: not 4x4, not finite, or further from a rotation than rounding goes.
        """
        T = check_transform(values, name=name, tolerance=ROUNDED)
        self._note(rotation_deviation(np.asarray(values, np.float64)[:3, :3]), name)
        return T

    def check_quaternion(self, q_xyzw: npt.ArrayLike, *, name: str) -> None:
        """Note a quaternion x y z w, whose length may be rounded; `name` is its place.

        Raises:
            BadInputError: kind `bad_transform`: its length is further from 1 than rounding goes.
        """
        length = float(np.linalg.norm(np.asarray(q_xyzw, np.float64)))
        if not abs(length - 1) <= ROUNDED:
            raise BadInputError(
                "bad_transform",
                f"{name}: a quaternion has length 1 (at most {ROUNDED:g} off), got {np.asarray(q_xyzw).tolist()} of "
                f"length {length:.4g}; four numbers x y z w are expected",
            )
        self._note(abs(length - 1), name)

    def text(self) -> str | None:
        """Sentence about the changes; None if there is none to tell."""
        if not self.rounded:
            return None
        return (
            f"{self.rounded} of {self.poses} poses were no exact rotations, and the nearest ones were taken: "
            f"off by {self.largest:.1e} at most, in {self.where}"
        )

    def _note(self, deviation: float, where: str) -> None:
        self.poses += 1
        self.rounded += deviation > EXACT
        if deviation > self.largest:
            self.largest, self.where = deviation, where
