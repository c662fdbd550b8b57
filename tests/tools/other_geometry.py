"""Targets and projections that no product has yet: a wall, a cylinder, rational polynomials."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.geometry.grid import Placement, Window


@dataclass(frozen=True, eq=False)
class Wall:
    """u to the right along a wall, v down it, h out of it towards the viewer."""

    origin: tuple[float, float, float]
    """Upper-left corner."""
    along: tuple[float, float, float]
    """Unit vector of u; v goes straight down."""
    pixel: float
    size: tuple[int, int]
    breaks = None

    @property
    def window(self) -> Window:
        return self.placement.window

    @property
    def placement(self) -> Placement:
        return Placement(self.size, (self.pixel, 0.0, 0.0, 0.0, -self.pixel, 0.0), None, "metre")

    def to_ground(self, uvh: ArrayLike) -> NDArray[np.float64]:
        u, v, h = np.moveaxis(np.asarray(uvh, float), -1, 0)
        right, down = np.array(self.along), np.array((0.0, 0.0, -1.0))
        out = np.cross(down, right)
        at = np.array(self.origin) + ((u + 0.5) * self.pixel)[..., None] * right
        return at + ((v + 0.5) * self.pixel)[..., None] * down + h[..., None] * out


@dataclass(frozen=True, eq=False)
class Cylinder:
    """A standing cylinder unrolled: u is the arc, v goes down, h outwards."""

    centre: tuple[float, float]
    top: float
    radius: float
    pixel: float
    size: tuple[int, int]
    breaks = None

    @property
    def window(self) -> Window:
        return self.placement.window

    @property
    def placement(self) -> Placement:
        return Placement(self.size, (self.pixel, 0.0, 0.0, 0.0, -self.pixel, self.top), None, "metre")

    def to_ground(self, uvh: ArrayLike) -> NDArray[np.float64]:
        u, v, h = np.moveaxis(np.asarray(uvh, float), -1, 0)
        angle = (u + 0.5) * self.pixel / self.radius
        r = self.radius + h
        x, y = self.centre[0] + r * np.cos(angle), self.centre[1] + r * np.sin(angle)
        return np.stack([x, y, self.top - (v + 0.5) * self.pixel], axis=-1)


@dataclass(frozen=True, eq=False)
class RationalPolynomials:
    """x and y as quotients of cubics of normalised map coordinates; it has no centre and no rays."""

    coefficients: NDArray[np.float64]
    """(4, 20): numerator and denominator of x, then of y, in the order of RPC00B."""
    offsets: NDArray[np.float64]
    """(5,): X, Y, Z, x, y."""
    scales: NDArray[np.float64]
    """(5,)"""
    size: tuple[int, int]
    field = None
    breaks = None

    def project_homogeneous(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        XYZ = np.asarray(XYZ, float)
        X, Y, Z = np.moveaxis((XYZ - self.offsets[:3]) / self.scales[:3], -1, 0)
        one = np.ones_like(X)
        terms = [one, X, Y, Z, X * Y, X * Z, Y * Z, X * X, Y * Y, Z * Z, X * Y * Z, X**3, X * Y * Y, X * Z * Z]
        terms += [X * X * Y, Y**3, Y * Z * Z, X * X * Z, Y * Y * Z, Z**3]
        up_x, low_x, up_y, low_y = np.moveaxis(np.stack(terms, axis=-1) @ self.coefficients.T, -1, 0)
        x = up_x / low_x * self.scales[3] + self.offsets[3]
        y = up_y / low_y * self.scales[4] + self.offsets[4]
        return np.stack([x, y, one], axis=-1)


def like_a_satellite(size: tuple[int, int], seed: int = 0) -> RationalPolynomials:
    """A pushbroom scene of 0.5 m pixels over 500 m: slightly turned, oblique, with small terms of every order."""
    rng = np.random.default_rng(seed)
    c = rng.normal(0, 2e-4, (4, 20))
    c[1, 0] = c[3, 0] = 1.0
    c[0, :4] = (0.0, 0.98, 0.12, 0.05)
    c[2, :4] = (0.0, 0.11, -0.97, 0.08)
    half = np.array(size) / 2
    return RationalPolynomials(
        c, np.array([0.0, 0.0, 100.0, *half]), np.array([half[0] * 0.5, half[1] * 0.5, 50.0, *half]), size
    )
