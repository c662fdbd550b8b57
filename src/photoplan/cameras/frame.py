"""Frame cameras: interior orientation, collinearity equations, oriented cameras."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.cameras.base import ImageField, Vantage
from photoplan.cameras.fiducials import Affine2D
from photoplan.cameras.lenses import FieldLimited, Interior, Lens, NoLens, field_limited
from photoplan.errors import UsageError
from photoplan.geometry.pose import Pose

#: Largest tangent of an image's border up to which a lens is a field. A fisheye beyond it (63°) strays so far from the
#: ideal plane that a table of its displacements would be larger than the image.
WIDEST_FIELD = 2.0


@dataclass(frozen=True)
class LensField:
    """From where an image point would lie without distortion, on an affine image plane, to where it lies.

    Equal for all images of one lens and one interior orientation.
    """

    interior: Interior
    lens: Lens
    breaks: None = field(default=None, init=False)
    """Lenses are smooth."""
    _to_tangent: Affine2D = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_to_tangent", ~ideal_plane(self.interior))

    def __call__(self, xy: ArrayLike) -> NDArray[np.float64]:
        """Ideal to real positions, shapes (..., 2), pixels."""
        with np.errstate(invalid="ignore", over="ignore"):
            return self.interior.tangent_to_pixel(self.lens.distort(self._to_tangent(xy)))

    def inverse(self, xy: ArrayLike) -> NDArray[np.float64]:
        """Real to ideal positions, shapes (..., 2), pixels; NaN where there are none."""
        return ideal_plane(self.interior)(self.lens.undistort(self.interior.tangent_to_pixel.inverse(xy)))


def ideal_plane(interior: Interior) -> Affine2D:
    """From tangents to pixels without what is bilinear: its tangent at the principal point."""
    T = interior.tangent_to_pixel
    return T if isinstance(T, Affine2D) else Affine2D(a1=T.b1, a2=T.b2, a3=T.b4, a4=T.b5, a5=T.b6, a6=T.b8)


@dataclass(frozen=True, eq=False)
class FrameCamera:
    """A frame image in Cartesian ground space (Ecker 1991, eq. 3.1–3.3).

    The camera axes are x right, y up, z towards the viewer: the scene lies at z < 0 and depth = −z. An image whose
    orientation was determined with the scene at z > 0 (ω near 200 gon, as in Ecker 1991, §8.1) is brought into this
    system by turning its axes, R · diag(1, −1, −1), and changing the sign of its image x.

    Its lens and a bilinear interior orientation are its `field`, the rest is linear. Only a fisheye whose image reaches
    beyond 63° from the axis has no field: its lens then is part of `project_homogeneous`, which gives NaN with w ≤ 0 at
    and behind the camera's plane.

    Raises
    ------
    InputError
        The lens folds back inside the image.
    """

    interior: Interior
    lens: Lens
    pose: Pose
    """Exterior orientation."""
    breaks: None = dataclasses.field(default=None, init=False)
    """The mapping is smooth."""
    field: ImageField | None = dataclasses.field(init=False, repr=False)
    """Lens and film deformation; None: there are none, or it is a wide fisheye."""
    _lens: Lens = dataclasses.field(init=False, repr=False)
    _linear: NDArray[np.float64] | None = dataclasses.field(init=False, repr=False)
    _axes: NDArray[np.float64] = dataclasses.field(init=False, repr=False)

    def __post_init__(self) -> None:
        plain = isinstance(self.lens, NoLens | FieldLimited)
        lens = self.lens if plain else field_limited(self.lens, self.interior)
        object.__setattr__(self, "_lens", lens)
        # Columns: camera x, camera y, depth.
        axes = np.ascontiguousarray(self.pose.R_ground_camera * (1.0, 1.0, -1.0))
        object.__setattr__(self, "_axes", axes)
        ideal = isinstance(lens, NoLens) and isinstance(self.interior.tangent_to_pixel, Affine2D)
        wide = isinstance(lens, FieldLimited) and lens.radius > WIDEST_FIELD
        object.__setattr__(self, "field", None if ideal or wide else LensField(self.interior, lens))
        T = ideal_plane(self.interior)
        linear = axes @ np.array([[T.a1, T.a4, 0.0], [T.a2, T.a5, 0.0], [T.a3, T.a6, 1.0]])
        object.__setattr__(self, "_linear", None if wide else linear)

    def turned(self, R: NDArray[np.float64], longer: float = 1.0) -> FrameCamera:
        """It with its axes turned by R, shape (3, 3), about themselves, and a camera constant that is longer."""
        interior = dataclasses.replace(self.interior, c=self.interior.c * longer)
        pose = Pose(self.pose.center, self.pose.R_ground_camera @ R)
        return dataclasses.replace(self, interior=interior, pose=pose)

    def moved(self, aside: float) -> FrameCamera:
        """It from so many metres to the right along the rows of its picture."""
        R = self.pose.R_ground_camera
        return dataclasses.replace(self, pose=Pose(self.pose.center + aside * R[:, 0], R))

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the image in pixels."""
        return self.interior.size

    @property
    def center(self) -> NDArray[np.float64]:
        """Projection centre in ground coordinates, shape (3,)."""
        return self.pose.center

    @property
    def vantage(self) -> Vantage:
        """The projection centre."""
        return Vantage(self.center)

    def project_homogeneous(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """Ground (..., 3) to ideal (x·w, y·w, w), w = depth in metres; linear in XYZ but for a wide fisheye."""
        XYZ = np.asarray(XYZ, float)
        from_center = (XYZ - self.pose.center).reshape(-1, 3)
        if self._linear is not None:
            return (from_center @ self._linear).reshape(XYZ.shape)
        p = from_center @ self._axes
        w = p[:, 2]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            t = p[:, :2] / np.where(w > 0, w, np.nan)[:, None]
            out = np.empty_like(p)
            np.multiply(self.interior.tangent_to_pixel(self._lens.distort(t)), w[:, None], out=out[:, :2])
        out[:, 2] = w
        return out.reshape(XYZ.shape)

    def rays(self, xy: ArrayLike, height: float | None = None) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Image points (..., 2) to the projection centre and unit directions, each (..., 3); `height` is not used."""
        d = self.directions(xy)
        d /= np.linalg.norm(d, axis=-1, keepdims=True)
        return np.broadcast_to(self.pose.center, d.shape).copy(), d

    def directions(self, xy: ArrayLike) -> NDArray[np.float64]:
        """Directions (..., 3) of the rays of image points (..., 2), as long as it takes to go one metre into depth."""
        t = self._lens.undistort(self.interior.tangent_to_pixel.inverse(xy))
        # Column by column: a product with a matrix this narrow is slower.
        x, y, out = t[..., 0], t[..., 1], np.empty((*t.shape[:-1], 3))
        for k, a in enumerate(self._axes):
            out[..., k] = x * a[0] + y * a[1] + a[2]
        return out

    def derivatives(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """∂(x, y)/∂(X, Y, Z), shape (..., 2, 3), pixels per metre; NaN behind the camera."""
        p = (np.asarray(XYZ, float) - self.pose.center) @ self._axes
        depth = np.where(p[..., 2] > 0, p[..., 2], np.nan)
        t = p[..., :2] / depth[..., None]
        # t = p / depth: its derivative by camera x, camera y, depth.
        inner = np.zeros((*t.shape[:-1], 2, 3))
        inner[..., 0, 0] = inner[..., 1, 1] = 1.0
        inner[..., :, 2] = -t
        real = self._lens.distort(t)
        outer = self.interior.tangent_to_pixel.derivative(real) @ self._lens.jacobian(t)
        return outer @ (inner / depth[..., None, None]) @ self._axes.T

    def matrix(self) -> NDArray[np.float64]:
        """The projection as one matrix P (3, 4): (x·w, y·w, w) = P (X, Y, Z, 1) (Ecker 1991, appendix B).

        Raises
        ------
        UsageError
            The camera has a lens or a bilinear interior orientation; no matrix holds these.
        """
        if self._linear is None or self.field is not None:
            raise UsageError("only an undistorted camera with affine interior orientation is a matrix")
        return np.concatenate([self._linear.T, -(self.pose.center @ self._linear)[:, None]], axis=1)
