"""What the tests of orientation formats share: cameras that read blocks give, and blocks to write."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from photoplan.cameras.base import Camera, project
from photoplan.cameras.frame import FrameCamera
from photoplan.cameras.framed import oriented_camera
from photoplan.geometry.pose import Pose
from photoplan.io.camera.model import BrownLens, FrameEntry, IdealLens, OpenCVFisheyeLens, OpenCVLens
from photoplan.io.formats import read_orientation_block, write_orientation
from photoplan.io.orientation.block import OrientationBlock, OrientationTable, OrientedImage, TableFormat
from photoplan.io.project.model import Image, interior_of, lens_of

LENSES: dict[str, Any] = {
    "none": IdealLens(),
    "brown": BrownLens(type="brown", k1=-0.05, k2=0.01, k3=-0.002, p1=3e-4, p2=-2e-4),
    "brown with shear": BrownLens(type="brown", k1=-0.05, k2=0.01, p1=3e-4, p2=-2e-4, b1=4e-4, b2=-3e-4, k4=1e-3),
    "brown with affinity": BrownLens(type="brown", k1=-0.05, k2=0.01, p1=3e-4, p2=-2e-4, b1=4e-4),
    "opencv": OpenCVLens(type="opencv", k1=-0.05, k2=0.01, p1=3e-4, p2=-2e-4, k3=1e-3),
    "rational": OpenCVLens(type="opencv", k1=0.1, k2=0.01, p1=3e-4, k3=1e-3, k4=0.15, k5=2e-3, k6=1e-5),
    "fisheye": OpenCVFisheyeLens(type="opencv_fisheye", k1=-0.03, k2=0.004, k3=-1e-3, k4=1e-4),
}


def frame(lens: str = "none", **more: Any) -> FrameEntry:
    """A camera of 4000 × 3000 px that lies about its middle."""
    values: dict[str, Any] = {
        "size": (4000, 3000),
        "focal_px": (3100.0, 3102.5),
        "principal_point_px": (2010.25, 1480.5),
    }
    return FrameEntry(**(values | {"lens": LENSES[lens]} | more))


def block_of(
    cameras: Mapping[str, FrameEntry],
    n: int = 5,
    middle: Any = (500_000.0, 5_400_000.0, 900.0),
    **table: Any,
) -> OrientationBlock:
    """`n` images over `middle`, tilted by up to 20°, the cameras in turn."""
    rng = np.random.default_rng(8)
    names = list(cameras)
    images = []
    for k in range(n):
        x, y, z = (np.asarray(middle) + rng.uniform(-400, 400, 3) * [1, 1, 0.2]).tolist()
        w, p, kappa = (rng.uniform(-1, 1, 3) * [20, 20, 180]).tolist()
        camera = names[k % len(names)] if names else None
        images.append(OrientedImage(f"DJI {k:04d}.JPG", (x, y, z), (w, p, kappa), camera))
    return OrientationBlock(OrientationTable(Path("given.toml"), tuple(images), **table), dict(cameras))


def camera_of(block: OrientationBlock, k: int = 0, crs: str | None = None) -> Camera:
    """Camera of an image: in Cartesian space, or strictly on the map of a CRS."""
    image = block.table.images[k]
    description = block.camera(image)
    size = block.size(image)
    entry = Image(name="x", file="x", camera="c", center=image.center, angles=(0.0, 0.0, 0.0), size=size)
    pose = Pose(np.array(image.center), block.table.rotations[k])
    if crs is None:
        return FrameCamera(interior_of(description, entry), lens_of(description), pose)
    return oriented_camera(
        interior_of(description, entry), lens_of(description), pose, crs=crs, earth_curvature="strict"
    )


def pixels(block: OrientationBlock, ground: Any, k: int = 0, crs: str | None = None) -> np.ndarray:
    """Column and row of ground points in an image of the block."""
    return project(camera_of(block, k, crs), ground)


def below(block: OrientationBlock, k: int, n: int = 30) -> np.ndarray:
    """Ground points that an image sees."""
    camera = camera_of(block, k)
    rng = np.random.default_rng(k)
    width, height = camera.size
    origins, rays = camera.rays(rng.uniform([0, 0], [width, height], (n, 2)))
    return origins + rays * rng.uniform(80, 200, (n, 1))


def round_trip(block: OrientationBlock, path: Path, format: str, form: TableFormat | None = None) -> OrientationBlock:
    """The block written and read again."""
    write_orientation(block, path, format)
    return read_orientation_block(path, form, format)


def assert_same(a: OrientationBlock, b: OrientationBlock, position: float = 1e-9, angle: float = 1e-9) -> None:
    """Equal names and poses, and cameras that see every point at the same pixel."""
    assert [i.name for i in a.table.images] == [i.name for i in b.table.images]
    np.testing.assert_allclose(a.table.centers, b.table.centers, rtol=0, atol=position)
    np.testing.assert_allclose(a.table.rotations, b.table.rotations, rtol=0, atol=angle)
    if b.cameras:
        assert_same_cameras(a, b)


def assert_same_cameras(a: OrientationBlock, b: OrientationBlock) -> None:
    rng = np.random.default_rng(1)
    t = rng.uniform(-0.6, 0.6, (200, 2))
    for k, (first, second) in enumerate(zip(a.table.images, b.table.images)):
        one, two = a.camera(first), b.camera(second)
        assert a.size(first) == b.size(second)
        entry = Image(name="x", file="x", camera="c", center=(0, 0, 0), angles=(0, 0, 0), size=a.size(first))
        where = [interior_of(c, entry).tangent_to_pixel(lens_of(c).distort(t)) for c in (one, two)]
        np.testing.assert_allclose(where[0], where[1], rtol=1e-12, atol=1e-12 * 4000, err_msg=str(k))


def with_table(block: OrientationBlock, **changes: Any) -> OrientationBlock:
    """The block with other entries of its table."""
    return replace(block, table=replace(block.table, **changes))
