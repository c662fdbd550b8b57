"""Camera protocols: projection from ground to image, and rays. The rest of photoplan knows nothing more of a camera."""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.geometry.grid import Breaks


class ImageField(Protocol):
    """Displacements in the image, whatever the ground: from ideal positions (of the projective factor) to real ones.

    Lens distortion, film deformation, the remainder of each line of a trajectory. Continuous, and close to the
    identity: two points keep their order. All methods are vectorised; NaN in gives NaN out.
    """

    @property
    def breaks(self) -> Breaks | None:
        """Return where it is bent, by ideal positions; None: nowhere."""
        ...

    def __call__(self, xy: ArrayLike) -> NDArray[np.float64]:
        """Ideal to real positions, shapes (..., 2), pixels."""
        ...

    def inverse(self, xy: ArrayLike) -> NDArray[np.float64]:
        """Real to ideal positions, shapes (..., 2), pixels; NaN where there are none."""
        ...

    def __hash__(self) -> int:
        """Fields are values or compared by identity: usable as keys either way."""
        ...


class Tremor(Protocol):
    """Trajectory jitter: the part of a mapping that changes from line to line of the image."""

    @property
    def largest(self) -> NDArray[np.float64]:
        """Largest shifts along x and y of blocks of lines against the smooth part, (k, 2), pixels."""
        ...

    @property
    def smooth(self) -> Projection:
        """The mapping without it."""
        ...

    def part(self, XYZ: NDArray[np.float64]) -> TremorPart | None:
        """For the ground that points (n, 3) enclose; None: the image does not show it.

        Ground beside it has the same part, one that can be a key: what is made of it can be kept.
        """
        ...

    def told(self, height: float) -> str:
        """Return how strong it is, and how much of the ground at a height is seen several times: a sentence."""
        ...


class TremorPart(Hashable, Protocol):
    """Some lines of such an image.

    The smooth part says where a ground point would lie, *ideally*; the real position differs by a shift that belongs to
    the *real* row and the ideal column, and is linear in the height of the ground but for next to nothing.
    """

    @property
    def smooth(self) -> Projection:
        """The mapping without tremor."""
        ...

    @property
    def rows(self) -> tuple[int, int]:
        """First and last row at which anything of the ground can be seen."""
        ...

    def shifts(
        self, columns: NDArray[np.float64], rows: NDArray[np.float64], heights: Sequence[float]
    ) -> NDArray[np.float64]:
        """Real minus ideal positions of ground of some heights that is seen in rows (n,), at ideal columns (m,).

        Shape (heights, n, m, 2). Between whole rows they are those of the rows around by cubic convolution.
        """
        ...


@dataclass(frozen=True, eq=False)
class Part:
    """Some columns of an image, with a smooth mapping of their own."""

    projection: Projection
    """Camera of all columns; it holds for its own."""
    first: float
    """Outer edge of the first of them."""
    end: float
    """Outer edge of the last."""
    before: float = 0.0
    """Pixels beyond the first edge that its border pixels show, up to the next part; below 0: what it leaves to it."""
    after: float = 0.0
    """The same beyond the last edge."""
    rest: bool = False
    """Whether it has stood before, and now shows what all have left near its edges."""


@dataclass(frozen=True, eq=False)
class Parts:
    """An image of parts beside each other, as of a line of several chips: between them the mapping has a step."""

    parts: tuple[Part, ...]
    """Parts in order; the first that sees a place counts."""


class Projection(Protocol):
    """A mapping from ground to image in two factors: a projective or smooth one, and a field in the image.

    Ground coordinates are those of the product: projected X, Y and height Z, metres. Image coordinates are
    (x, y) = (column, row) in pixels, (0, 0) the centre of the upper-left pixel. All methods are vectorised. Where a
    point lies in the image is told by `project`.
    """

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the image in pixels."""
        ...

    @property
    def field(self) -> ImageField | None:
        """The second factor; None: ideal positions are the real ones."""
        ...

    @property
    def breaks(self) -> Breaks | Tremor | Parts | None:
        """Return where the first factor is bent, by its ideal positions (knots of a trajectory), or what bends it
        at every line, or the parts between which it has steps; None if it is bent nowhere."""
        ...

    def project_homogeneous(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """First factor: ground (..., 3) to homogeneous ideal positions (x·w, y·w, w), shape (..., 3).

        w is positive in front of the camera, zero or negative behind, and for a frame camera all three are linear in
        XYZ, whatever its lens. NaN in gives NaN out.
        """
        ...


@dataclass(frozen=True, eq=False)
class Vantage:
    """From where a camera looks down, as far as a plan has to know it: whether or not its rays meet in a point."""

    point: NDArray[np.float64]
    """X, Y near what the camera sees, and a height above which it sees nothing; shape (3,). The projection centre of a
    central camera."""
    floor: float = -math.inf
    """Nothing below it is seen, metres: there the camera's geometry is not known any more."""
    reach: float | None = None
    """Ground that is seen lies no further than this from the point, on the map, metres; None: the camera is central,
    and sees whatever is not too flat."""

    @property
    def central(self) -> bool:
        """Return whether all rays pass through the point."""
        return self.reach is None


class Rays(Protocol):
    """Camera whose rays can be followed from image points to the ground."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the image in pixels."""
        ...

    def rays(self, xy: ArrayLike, height: float | None = None) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Image points (..., 2) to rays: an origin and a unit direction (pointing away from the camera), each (..., 3).

        In Cartesian ground space the origin is the projection centre and `height` is not needed. Where the ray is
        curved in map coordinates (earth curvature, refraction) the origin is the ray's point at `height` and the line
        is its tangent there; `height` is then required. Points that no ray reaches give NaN.
        """
        ...


class Camera(Projection, Rays, Protocol):
    """A projection that can be followed back to the ground. Rays and derivatives are those of both factors."""

    @property
    def vantage(self) -> Vantage:
        """Return where it looks from."""
        ...

    def derivatives(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """∂(x, y)/∂(X, Y, Z), shape (..., 2, 3), pixels per metre; NaN behind the camera."""
        ...


class CentralCamera(Camera, Protocol):
    """A camera whose rays all pass through one point."""

    @property
    def center(self) -> NDArray[np.float64]:
        """Projection centre in ground coordinates, shape (3,)."""
        ...


def project(projection: Projection, XYZ: ArrayLike) -> NDArray[np.float64]:
    """Ground points (..., 3) to image points (..., 2) in pixels; NaN at and behind the camera's plane."""
    h = projection.project_homogeneous(XYZ)
    w = h[..., 2:]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        ideal = np.where(w > 0, h[..., :2] / w, np.nan)
    return ideal if projection.field is None else projection.field(ideal)


def on_level(camera: Camera, xy: ArrayLike, level: float) -> NDArray[np.float64]:
    """Return where rays of image points (n, 2) go down to a level, (n, 3); NaN where they do not."""
    origin, direction = camera.rays(xy, level)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (level - origin[:, 2:]) / direction[:, 2:]
        # Rays that have no common centre may begin below a level.
        down = (direction[:, 2:] < 0) & ((t > 0) | (not camera.vantage.central))
        return np.where(down, origin + t * direction, np.nan)


def tremor_of(projection: Projection) -> Tremor | None:
    """Return what of it changes from line to line; None: nothing does."""
    breaks = projection.breaks
    return None if breaks is None or isinstance(breaks, Breaks | Parts) else breaks


def parts_of(projection: Projection) -> tuple[Part | None, ...]:
    """The parts of its image; (None,): it is one."""
    breaks = projection.breaks
    return breaks.parts if isinstance(breaks, Parts) else (None,)


def steady(projection: Projection) -> Projection:
    """A mapping without its tremor: the place from which ground is seen does not shake, and moves on evenly."""
    tremor = tremor_of(projection)
    return projection if tremor is None else tremor.smooth


def tremor_told(projection: Projection, height: float) -> str | None:
    """Return how strongly it shakes, see `Tremor.told`; None: it does not. Parts of one image shake alike."""
    tremors = tremors_of(projection)
    return tremors[0].told(height) if tremors else None


def tremors_of(projection: Projection) -> list[Tremor]:
    """Return what of it and of the parts of its image changes from line to line; empty: nothing does."""
    each = [tremor_of(projection if part is None else part.projection) for part in parts_of(projection)]
    return [tremor for tremor in each if tremor is not None]
