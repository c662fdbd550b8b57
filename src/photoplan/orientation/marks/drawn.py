"""Templates that were drawn a moment ago are kept: marks of one camera often look the same."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.mark_pattern import MarkExample, MarkPattern
from photoplan.orientation.marks.template import Template, render


def draw(
    pattern: MarkPattern | MarkExample,
    mm_to_pixel: NDArray[np.float64] | Sequence[Sequence[float]],
    *,
    negative: bool = False,
    blur_px: float = 0.7,
) -> Template:
    """What `render` draws, or drew for the same pattern, matrix, tone and blur; see there."""
    matrix = np.asarray(mm_to_pixel, float)
    return _drawn(pattern, matrix.shape, tuple(matrix.ravel().tolist()), negative, float(blur_px))


@lru_cache(maxsize=48)
def _drawn(
    pattern: MarkPattern | MarkExample, shape: tuple[int, int], matrix: tuple[float, ...], negative: bool, blur: float
) -> Template:
    return render(pattern, np.array(matrix).reshape(shape), negative=negative, blur_px=blur)
