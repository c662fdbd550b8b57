"""Signs by chance that are always the same at a place, whichever block looks at it."""

from __future__ import annotations

import numpy as np

from photoplan.kernels.jit import inner, kernel


@inner
def sign_at(i, j):
    """1 or −1, by chance, but always the same at a place (MurmurHash3's mixing, Appleby 2011)."""
    mixed = np.uint64(i) * np.uint64(0x9E3779B97F4A7C15) + np.uint64(j) * np.uint64(0xC2B2AE3D27D4EB4F)
    mixed = (mixed ^ (mixed >> np.uint64(33))) * np.uint64(0xFF51AFD7ED558CCD)
    mixed = (mixed ^ (mixed >> np.uint64(33))) * np.uint64(0xC4CEB9FE1A85EC53)
    return 1.0 if (mixed >> np.uint64(40)) & np.uint64(1) else -1.0


@kernel
def signs_at(col, row, out):
    """`sign_at` of the places of a grid whose first one is (col, row), for each of the layers of `out`, (k, m, n)."""
    for k in range(out.shape[0]):
        for j in range(out.shape[1]):
            for i in range(out.shape[2]):
                out[k, j, i] = sign_at((col + i) * 4 + k, row + j)
