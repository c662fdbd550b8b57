"""What curvatures pull heights by."""

from __future__ import annotations

from photoplan.kernels.jit import kernel


@kernel
def pull(weights, heights, out):
    """Half the gradient of the weighted sum of squared curvatures.

    Parameters
    ----------
    weights : ndarray, shape (3, rows, columns)
        Of curvatures along columns, rows and across, see `facets_solve.curvature`; 0 where not inside.
    heights, out : ndarray, shape (rows, columns)
        `out` is changed.
    """
    rows, columns = heights.shape
    out[:] = 0.0
    for j in range(rows):
        for i in range(1, columns - 1):
            part = weights[0, j, i] * (heights[j, i - 1] - 2.0 * heights[j, i] + heights[j, i + 1])
            out[j, i - 1] += part
            out[j, i] -= 2.0 * part
            out[j, i + 1] += part
    for j in range(1, rows - 1):
        for i in range(columns):
            part = weights[1, j, i] * (heights[j - 1, i] - 2.0 * heights[j, i] + heights[j + 1, i])
            out[j - 1, i] += part
            out[j, i] -= 2.0 * part
            out[j + 1, i] += part
    for j in range(rows - 1):
        for i in range(columns - 1):
            part = heights[j, i] - heights[j, i + 1] - heights[j + 1, i] + heights[j + 1, i + 1]
            part *= weights[2, j, i]
            out[j, i] += part
            out[j, i + 1] -= part
            out[j + 1, i] -= part
            out[j + 1, i + 1] += part
