"""On which side of breaklines a point lies, as coordinates.

A line of constant sign cannot tell the two sides of a line that ends: around its end one gets from one side to the
other. The angle that a line subtends, seen from a point and counted with its sign, does: it jumps by 2π across the line
and passes smoothly through all values around the end. The sine of half of it lies in [−1, 1] and changes by 2 across
the middle of a line. Used as further coordinates in the distance of a covariance function, one for each line, it
separates the sides and leaves every covariance matrix positive definite (design/007).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.jit import kernel


@kernel
def sides_of(xy: NDArray[Any], vertices: NDArray[Any], start: NDArray[Any], pieces: int, result: NDArray[Any]) -> None:
    """result[i, l] = sin(θ/2) of point i and piece l; vertices of piece l are vertices[start[l]:start[l + 1]].

    e^{iα/2} of every segment's angle α in (−π, π) is multiplied up: θ is then followed over several turns without an
    inverse function.
    """
    for line in range(pieces):
        first, last = start[line], start[line + 1]
        for i in range(xy.shape[0]):
            re, im = 1.0, 0.0
            ax, ay = vertices[first, 0] - xy[i, 0], vertices[first, 1] - xy[i, 1]
            ra = np.sqrt(ax * ax + ay * ay)
            for k in range(first + 1, last):
                bx, by = vertices[k, 0] - xy[i, 0], vertices[k, 1] - xy[i, 1]
                rb = np.sqrt(bx * bx + by * by)
                # Half-angle: cos(α/2) ~ rr + a·b, sin(α/2) ~ a×b, both over the same length.
                c = ra * rb + ax * bx + ay * by
                s = ax * by - ay * bx
                length = np.sqrt(c * c + s * s)
                if length > 0.0:
                    c, s = c / length, s / length
                    re, im = re * c - im * s, re * s + im * c
                ax, ay, ra = bx, by, rb
            result[i, line] = im


@kernel
def clip_lines(
    lines: NDArray[Any], start: NDArray[Any], box: NDArray[Any], out: NDArray[Any], out_start: NDArray[Any]
) -> int:
    """The parts of lines that pass a box, prolonged far outwards where they leave it; returns the number of pieces.

    Parameters
    ----------
    lines : ndarray, shape (v, 2)
        Vertices of all lines; line l has lines[start[l]:start[l + 1]].
    box : ndarray, shape (4,)
        xmin, ymin, xmax, ymax.
    out, out_start : ndarrays
        Receive the vertices and beginnings of the pieces; what finds no room is left out.
    """
    far = 20.0 * max(box[2] - box[0], box[3] - box[1])
    pieces, count = 0, 0
    out_start[0] = 0
    for line in range(len(start) - 1):
        inside = False
        for k in range(start[line], start[line + 1] - 1):
            ax, ay, bx, by = lines[k, 0], lines[k, 1], lines[k + 1, 0], lines[k + 1, 1]
            meets = max(ax, bx) >= box[0] and min(ax, bx) <= box[2] and max(ay, by) >= box[1] and min(ay, by) <= box[3]
            if meets and not inside:
                if pieces + 2 > len(out_start) or count + 4 > len(out):
                    return pieces
                inside = True
                if k > start[line]:
                    scale = far / max(np.hypot(bx - ax, by - ay), 1e-9)
                    out[count, 0], out[count, 1] = ax - scale * (bx - ax), ay - scale * (by - ay)
                    count += 1
                out[count, 0], out[count, 1] = ax, ay
                count += 1
            if inside and meets:
                if count + 2 > len(out):
                    out_start[pieces + 1] = count
                    return pieces + 1
                out[count, 0], out[count, 1] = bx, by
                count += 1
            last = k == start[line + 1] - 2
            if inside and (last or not meets):
                if not meets:  # the segment before this one was the last that met the box
                    px, py = lines[k - 1, 0], lines[k - 1, 1]
                    scale = far / max(np.hypot(ax - px, ay - py), 1e-9)
                    out[count, 0], out[count, 1] = ax + scale * (ax - px), ay + scale * (ay - py)
                    count += 1
                pieces += 1
                out_start[pieces] = count
                inside = False
    return pieces
