"""Radiometric transfer parameters of images, with local validity."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.facets_radiometry import add_radiometry, solve_radiometry, transferred
from photoplan.matching.facets.observe import Facets, Sight

_Floats = NDArray[np.float32]
_Doubles = NDArray[np.float64]

#: Posts between nodes of the lattice of parameters.
PATCH = 24
#: What neighbouring nodes may differ by, parts of the contrast: weak, a patch of pixels knows its own far better.
_CHANGE = 0.02


@dataclass(frozen=True, eq=False)
class Transfer:
    """g = offset + gain · G for the grey values g of an image and G of the surface, bilinear over a lattice.

    Schlüter 2001, eq. 1 has h1 + h2 · g = G, hence h2 = 1/gain and h1 = −offset/gain.
    """

    offsets: _Doubles
    """At the nodes, shape (rows, columns)."""
    gains: _Doubles
    left: float
    top: float
    """X and Y of the first node."""
    pitch: float
    """Between nodes, metres."""

    def on(self, facets: Facets) -> Transfer:
        """The parameters at the lattice of other facets; beyond the border those of the border."""
        new = blank(facets)
        XY = new._nodes.posts
        offsets, gains = self._nodes.sampled(self.offsets, XY), self._nodes.sampled(self.gains, XY)
        return replace(new, offsets=offsets, gains=gains)

    def apply(self, sight: Sight, facets: Facets) -> _Floats:
        """Grey values of a view's pixels in the system of the surface, shape (h, w); NaN off the surface."""
        out = np.empty(sight.raw.shape, np.float32)
        transferred(sight.places, sight.raw, self.offsets, self.gains, self._lattice(facets), out)
        return out

    def improved(self, sight: Sight, facets: Facets, weights: _Floats, surface: _Floats, contrast: float) -> Transfer:
        """Least squares from grey values of the surface at the pixels' places (h, w) and their weights."""
        rows, columns = self.offsets.shape
        n = rows * columns
        system, right = np.zeros((2 * n, 2 * n)), np.zeros(2 * n)
        lattice = self._lattice(facets)
        add_radiometry(sight.places, sight.raw, weights, surface, (rows, columns), lattice, system, right)
        self._tie(system, right, contrast)
        solve_radiometry(system, right)
        offsets, gains = right[:n].reshape(rows, columns), right[n:].reshape(rows, columns)
        return replace(self, offsets=offsets, gains=np.maximum(gains, 0.05))

    @property
    def _nodes(self) -> Facets:
        rows, columns = self.offsets.shape
        return Facets(left=self.left, top=self.top, pitch=self.pitch, shape=(rows, columns), ratio=1)

    def _lattice(self, facets: Facets) -> tuple[float, float, float]:
        u, v = facets.to_posts((self.left, self.top))
        return float(u), float(v), self.pitch / facets.pitch

    def _tie(self, system: _Doubles, right: _Doubles, contrast: float) -> None:
        """Neighbours differ little; and what no pixel knows stays as it is."""
        rows, columns = self.offsets.shape
        n = rows * columns
        index = np.arange(n).reshape(rows, columns)
        pairs = np.concatenate([
            np.stack([index[:, :-1], index[:, 1:]], axis=-1).reshape(-1, 2),
            np.stack([index[:-1], index[1:]], axis=-1).reshape(-1, 2),
        ])  # fmt: skip
        for first, p in ((0, 1 / (_CHANGE * contrast) ** 2), (n, 1 / _CHANGE**2)):
            a, b = pairs.T + first
            np.add.at(system, (a, a), p)
            np.add.at(system, (b, b), p)
            np.add.at(system, (a, b), -p)
            np.add.at(system, (b, a), -p)
            every = np.arange(first, first + n)
            system[every, every] += 1e-6 * p
        right[:n] += 1e-6 * self.offsets.reshape(-1) / (_CHANGE * contrast) ** 2
        right[n:] += 1e-6 * self.gains.reshape(-1) / _CHANGE**2


def blank(facets: Facets) -> Transfer:
    """Offset 0 and gain 1 on the lattice of some facets: whichever block, its nodes lie at the same places."""
    pitch = PATCH * facets.pitch
    first, top = np.floor(facets.left / pitch + 1e-6), np.ceil(facets.top / pitch - 1e-6)
    right = facets.left + (facets.shape[1] - 1) * facets.pitch
    bottom = facets.top - (facets.shape[0] - 1) * facets.pitch
    columns = max(2, int(np.ceil(right / pitch - 1e-6) - first) + 1)
    rows = max(2, int(top - np.floor(bottom / pitch + 1e-6)) + 1)
    offsets, gains = np.zeros((rows, columns)), np.ones((rows, columns))
    return Transfer(offsets=offsets, gains=gains, left=first * pitch, top=top * pitch, pitch=pitch)


def first_guess(sights: Sequence[Sight], facets: Facets) -> list[Transfer]:
    """Parameters from means and contrasts of the pixels that lie on the surface."""
    found = []
    for sight in sights:
        values = sight.raw[np.isfinite(sight.raw) & np.isfinite(sight.places[..., 0])]
        found.append((float(values.mean()), float(values.std())) if values.size > 8 else (np.nan, np.nan))
    mean, contrast = np.nanmean(found, axis=0)
    out = []
    for own, spread in found:
        new = blank(facets)
        gain = spread / contrast if contrast > 0 and spread > 0.05 * contrast else 1.0
        out.append(replace(new, offsets=new.offsets + np.nan_to_num(own - gain * mean), gains=new.gains * gain))
    return out


def levelled(transfers: Sequence[Transfer]) -> list[Transfer]:
    """The same differences between images, with mean offset 0 and mean gain 1 at every node: what fixes the surface's
    own grey values."""
    offset = np.mean([t.offsets for t in transfers], axis=0)
    gain = np.mean([t.gains for t in transfers], axis=0)
    return [replace(t, offsets=t.offsets - t.gains * offset / gain, gains=t.gains / gain) for t in transfers]
