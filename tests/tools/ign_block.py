"""A project folder of the real UltraCam block `ign_borea`: 805 exposures, 68 of them measured, numbers only.

The published orientations (EPSG:2154) state altitudes above the geoid and carry the linear alteration of a block that
was adjusted in map coordinates; both are undone here, so that the project is strict with ellipsoidal heights.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rasterio
from numpy.typing import ArrayLike, NDArray
from pyproj import Transformer

from photoplan.geometry.local import LocalFrame
from photoplan.geometry.pose import angles_from_rotation, rotation_from_angles

__all__ = ["CRS", "Published", "ign_project", "published"]

CRS = "EPSG:2154"
CAMERA = "UCE-M3-f120-s06"
#: Width and height, focal length, principal point: pixels, the centre of the upper-left pixel is (0, 0).
SIZE, FOCAL, PRINCIPAL_POINT = (26460, 17004), 30975.0, (13210.0, 8502.0)


class Published:
    """Published orientations, with true ellipsoidal heights."""

    def __init__(self, names: list[str], centers: NDArray[np.float64], angles: NDArray[np.float64]) -> None:
        self.names = names
        self.centers = centers
        """(n, 3), map coordinates and ellipsoidal height."""
        self.angles = angles
        """ω, φ, κ in degrees, (n, 3)."""


def _rows(path: Path, fields: int) -> list[list[str]]:
    return [f for f in (line.split() for line in path.read_text().splitlines()) if len(f) >= fields]


def _undulations(path: Path, XY: NDArray[np.float64]) -> NDArray[np.float64]:
    """Geoid heights at map points (n, 2), bilinear between the grid's pixel centres."""
    with rasterio.open(path) as raster:
        grid, to_pixel = raster.read(1).astype(float), ~raster.transform
    lon, lat = Transformer.from_crs(CRS, "EPSG:4171", always_xy=True).transform(*XY.T)
    col, row = to_pixel.a * lon + to_pixel.c - 0.5, to_pixel.e * lat + to_pixel.f - 0.5
    j, i = col.astype(int), row.astype(int)
    u, v = col - j, row - i
    top = (1 - u) * grid[i, j] + u * grid[i, j + 1]
    bottom = (1 - u) * grid[i + 1, j] + u * grid[i + 1, j + 1]
    return (1 - v) * top + v * bottom


def published(data: Path) -> Published:
    """The published orientations of all exposures, geoid and alteration undone."""
    ground = {f[0]: float(f[3]) for f in _rows(data / "all_liaisons2_world.mes", 4)}
    seen: dict[str, list[float]] = {}
    for point, image in (f[:2] for f in _rows(data / "all_liaisons2.mes", 4)):
        if point in ground:
            seen.setdefault(image, []).append(ground[point])
    rows = _rows(data / "23FD1305_alt_2.OPK", 8)[1:]
    names = [f[0] for f in rows]
    centers = np.array([f[1:4] for f in rows], float)
    centers[:, 2] += _undulations(data / "fr_ign_RAF20.tif", centers[:, :2])
    # Exposures without a measured point take the mean height of all points.
    everywhere = float(np.mean(list(ground.values())))
    below = np.array([np.mean(seen[n]) if n in seen else everywhere for n in names])
    middle = centers[:, :2].mean(axis=0)
    scale = LocalFrame(CRS, (float(middle[0]), float(middle[1]))).scale(centers[:, :2])
    centers[:, 2] = unaltered_height(centers[:, 2], below, scale)
    return Published(names, centers, np.array([f[4:7] for f in rows], float))


def ign_project(
    folder: Path,
    data: Path,
    *,
    position_noise: float = 0.1,
    attitude_noise_deg: float = 0.01,
    seed: int = 0,
    sigma_control: float = 0.05,
    every: bool = True,
) -> Path:
    """Write project.toml with image_points.csv, control.csv and positions.csv; returns the project's path.

    Parameters
    ----------
    folder : Path
        Where to write; made if it is not there.
    data : Path
        The folder `ign_borea`.
    position_noise, attitude_noise_deg : float
        Standard deviation of the noise that is added to positions (metres) and to attitudes (small rotations about the
        camera's axes, degrees). The noisy values are observations and start values.
    seed : int
    sigma_control : float
        Stated standard deviation of each coordinate of control, metres.
    every : bool
        All 805 exposures; else the 68 that have measured points.
    """
    folder.mkdir(parents=True, exist_ok=True)
    truth = published(data)
    random = np.random.default_rng(seed)
    centers = truth.centers + random.normal(scale=position_noise, size=truth.centers.shape)
    turns = random.normal(scale=np.radians(attitude_noise_deg), size=truth.centers.shape)
    angles = np.array([_turned(a, turn) for a, turn in zip(np.radians(truth.angles), turns)])
    measured = _rows(data / "all_liaisons2.mes", 4) + _rows(data / "all_terrains2.mes", 4)
    lines = ["point,image,x,y", *(",".join([f[0].strip('"'), *f[1:4]]) for f in measured)]
    (folder / "image_points.csv").write_text("\n".join(lines) + "\n")
    control = [f"{f[0].strip(chr(34))},{f[2]},{f[3]},{f[4]}" for f in _rows(data / "GCP_test.app", 5)]
    (folder / "control.csv").write_text("\n".join(["name,x,y,z", *control]) + "\n")
    with_points = {f[1] for f in measured}
    keep = [k for k, name in enumerate(truth.names) if every or name in with_points]
    table = ["name,x,y,z,omega,phi,kappa,strip"]
    images = []
    for k in keep:
        numbers = [*(f"{v:.4f}" for v in centers[k]), *(f"{v:.8f}" for v in angles[k])]
        table.append(",".join([truth.names[k], *numbers, truth.names[k].split("_")[0]]))
        images.append(
            f'[[images]]\nname = "{truth.names[k]}"\nfile = "{truth.names[k]}.jp2"\ncamera = "{CAMERA}"\n'
            f"center = [{', '.join(numbers[:3])}]\nangles = [{', '.join(numbers[3:])}]\n"
        )
    (folder / "positions.csv").write_text("\n".join(table) + "\n")
    head = f"""format = 1
crs = "{CRS}"

[orientation]
height_system = "ellipsoidal"
angle_unit = "deg"
rotation = "opk"
earth_curvature = "strict"

[observations]
image_points = ["image_points.csv"]
control = ["control.csv"]
positions = "positions.csv"
sigma_image = 0.25
sigma_control = [{sigma_control}, {sigma_control}]
sigma_position = [{position_noise}, {position_noise}]
sigma_attitude = {attitude_noise_deg}

[cameras."{CAMERA}"]
type = "frame"
size = [{SIZE[0]}, {SIZE[1]}]
focal_px = {FOCAL}
principal_point_px = [{PRINCIPAL_POINT[0]}, {PRINCIPAL_POINT[1]}]

"""
    path = folder / "project.toml"
    path.write_text(head + "\n".join(images))
    return path


def _turned(angles: NDArray[np.float64], turn: NDArray[np.float64]) -> NDArray[np.float64]:
    """ω, φ, κ in degrees after small rotations about the camera's axes (R ← R · (1 + [δ]×), made a rotation again)."""
    a, b, c = turn
    near = np.eye(3) + np.array([[0.0, -c, b], [c, 0.0, -a], [-b, a, 0.0]])
    U, _, Vt = np.linalg.svd(near)
    return np.degrees(angles_from_rotation(rotation_from_angles(angles) @ U @ Vt))


def altered_height(Z_station: ArrayLike, Z_ground: ArrayLike, map_scale: ArrayLike) -> NDArray[np.float64]:
    """Height of a projection centre with the *linear alteration* of a block that was computed in map coordinates.

    Such a block treats the map as Cartesian. As horizontal distances carry the scale k of the map, its flying heights
    above ground carry it too: Zs' = Zg + k (Zs − Zg). Blocks of the French mapping agency are delivered so.

    Parameters
    ----------
    Z_station, Z_ground : array_like
        True height of the projection centre and mean height of the ground below, same height system, metres.
    map_scale : array_like
        Scale k of the map at the station (`LocalFrame.scale`).
    """
    Zs, Zg = np.asarray(Z_station, float), np.asarray(Z_ground, float)
    return Zg + np.asarray(map_scale, float) * (Zs - Zg)


def unaltered_height(Z_station: ArrayLike, Z_ground: ArrayLike, map_scale: ArrayLike) -> NDArray[np.float64]:
    """True height of a projection centre that carries the linear alteration; inverse of `altered_height`."""
    Zs, Zg = np.asarray(Z_station, float), np.asarray(Z_ground, float)
    return Zg + (Zs - Zg) / np.asarray(map_scale, float)
