"""Anderson acceleration of the block iteration (D. G. Anderson, doi:10.1145/321296.321305)."""

import numpy as np

from tigar_x.compat import FloatArray


class Anderson:
    """Mixes the last iterates of a fixed-point iteration ``x <- g(x)``.

    The next iterate is the combination of the last g(x) whose combined defect g(x) - x is smallest.

    Args:
        depth: number of earlier iterates that are mixed in, at least 1.
    """

    def __init__(self, depth: int) -> None:
        self._depth = depth
        self._images: list[FloatArray] = []
        self._defects: list[FloatArray] = []

    def next(self, x: FloatArray, image: FloatArray) -> FloatArray:
        """The next iterate.

        Args:
            x: present iterate.
            image: g(x), same shape.

        Returns:
            Accelerated iterate, same shape.
        """
        self._images.append(image.copy())
        self._defects.append(image - x)
        del self._images[: -self._depth - 1], self._defects[: -self._depth - 1]
        if len(self._images) == 1:
            return image
        defects = np.diff(self._defects, axis=0).T
        images = np.diff(self._images, axis=0).T
        weights = np.linalg.lstsq(defects, self._defects[-1], rcond=1e-12)[0]
        return np.asarray(image - images @ weights)
