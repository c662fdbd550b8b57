"""A small simulated block as a project folder: two strips of four images, measured without error where not asked.

Measurements come from `oriented_camera`, the cameras that products are made with, in map coordinates: a path of its own
beside the adjustment's.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.base import project
from photoplan.cameras.framed import oriented_camera
from photoplan.geometry.pose import ANGLE_UNITS, Pose, angles_from_rotation, rotation_from_angles
from photoplan.io.project.file import toml_value
from photoplan.io.project.model import Project, interior_of, lens_of

#: Far from the central meridian, so that convergence and scale of the map are large.
CRS = "EPSG:25832"
MIDDLE = np.array([690_000.0, 5_350_000.0])
GROUND, FLYING = 500.0, 1700.0
SIZE = (4000, 3000)
CAMERA: dict[str, Any] = {"type": "frame", "size": list(SIZE), "focal_px": 3600.0}
FILM: dict[str, Any] = {
    "type": "film",
    "size": list(SIZE),
    "camera_constant_mm": 153.0,
    "principal_point_mm": [0.01, -0.02],
    "fiducials_mm": {"a": [-85.0, -62.0], "b": [85.0, -62.0], "c": [85.0, 62.0], "d": [-85.0, 62.0]},
}
#: Scan of the film: 42.5 µm pixels, turned by 0.3°, sheared a little.
FILM_TO_PIXEL = np.array([[23.5, 0.12, 1999.0], [0.12, -23.45, 1499.0]])


@dataclass(frozen=True)
class Make:
    """What is to be made."""

    camera: dict[str, Any] = field(default_factory=lambda: dict(CAMERA))
    stated: dict[str, Any] = field(default_factory=dict)
    """Entries of the camera that the project states otherwise than they are."""
    curvature: str = "strict"
    refraction: bool = False
    unit: str = "deg"
    rotation: str = "opk"
    start: tuple[float, float] = (3.0, 0.3)
    """Error of the start values: metres, degrees; NaN: no start values."""
    pixel_noise: float = 0.0
    sigma_image: float = 0.3
    check: int = 0
    """How many of the nine ground points are check points."""
    positions: bool = False
    shift: dict[str, tuple[float, float, float]] = field(default_factory=dict)
    """By how much the observed positions of strips a and b are off, metres."""
    lever: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Antenna minus projection centre in camera axes, metres."""
    boresight_deg: tuple[float, float, float] | None = None
    """ω, φ, κ from observed attitudes' camera axes to the true ones; None: no attitudes are observed."""
    control: bool = True
    seed: int = 7


@dataclass(frozen=True, eq=False)
class Made:
    """A project and the truth."""

    path: Path
    names: tuple[str, ...]
    centers: NDArray[np.float64]
    rotations: NDArray[np.float64]
    points: dict[str, NDArray[np.float64]]

    def project_text(self) -> str:
        return self.path.read_text()


def write_project(folder: Path, make: Make = Make()) -> Made:
    """Write project.toml, points.csv, control.csv and, where asked, positions.csv."""
    folder.mkdir(parents=True, exist_ok=True)
    random = np.random.default_rng(make.seed)
    names, centers, angles = _stations(random)
    rotations = np.array([rotation_from_angles(a) for a in angles])
    points = _points(random)
    true = _project(make, names, centers, make.camera)
    rows, seen = [], dict.fromkeys(points, 0)
    for name, center, R in zip(names, centers, rotations):
        image = true.image(name)
        camera = oriented_camera(
            interior_of(true.cameras["cam"], image),
            lens_of(true.cameras["cam"]),
            Pose(center, R),
            crs=CRS,
            earth_curvature=make.curvature,
            refraction=make.refraction,
            mean_ground=GROUND,
        )
        for point, xy in zip(points, project(camera, np.array([*points.values()]))):
            if (xy > 0).all() and (xy < np.array(SIZE) - 1).all():
                xy = xy + random.normal(scale=make.pixel_noise, size=2) if make.pixel_noise else xy
                rows.append(f"{point},{name}.tif,{xy[0]:.8f},{xy[1]:.8f}")
                seen[point] += 1
    (folder / "points.csv").write_text("\n".join(["point,image,x,y", *rows]) + "\n")
    control = [name for name in points if name.startswith("G")]
    lines = ["name,x,y,z,role"]
    for k, name in enumerate(control):
        role = "check" if k >= len(control) - make.check else "control"
        lines.append(",".join([name, *(f"{v:.6f}" for v in points[name]), role]))
    (folder / "control.csv").write_text("\n".join(lines) + "\n")
    if make.positions:
        (folder / "positions.csv").write_text(_positions(make, names, centers, rotations))
    path = folder / "project.toml"
    path.write_text(_text(make, true, names, centers, rotations, random))
    return Made(path, names, centers, rotations, points)


def _stations(random: np.random.Generator) -> tuple[tuple[str, ...], NDArray[np.float64], NDArray[np.float64]]:
    names, centers, angles = [], [], []
    for strip in range(2):
        for k in range(4):
            names.append(f"{'ab'[strip]}{k + 1}")
            XY = MIDDLE + np.array([450.0 * (k - 1.5), 550.0 * (strip - 0.5)]) + random.uniform(-20, 20, 2)
            centers.append([*XY, FLYING + random.uniform(-20, 20)])
            kappa = 180.0 * strip + random.uniform(-4, 4)
            angles.append(np.radians([*random.uniform(-3, 3, 2), kappa]))
    return tuple(names), np.array(centers), np.array(angles)


def _points(random: np.random.Generator) -> dict[str, NDArray[np.float64]]:
    """Nine ground points with a mean height of `GROUND`, and tie points over 60 m of relief."""
    out = {}
    heights = random.uniform(-30, 30, 9)
    heights -= heights.mean()
    for k in range(9):
        XY = MIDDLE + np.array([550.0 * (k % 3 - 1), 400.0 * (k // 3 - 1)]) + random.uniform(-40, 40, 2)
        out[f"G{k + 1}"] = np.array([*XY, GROUND + heights[k]])
    for k in range(60):
        XY = MIDDLE + random.uniform(-1, 1, 2) * [1000.0, 650.0]
        out[f"T{k + 1}"] = np.array([*XY, GROUND + random.uniform(-30, 30)])
    return out


def _positions(make: Make, names: tuple[str, ...], centers: NDArray[np.float64], rotations: NDArray[np.float64]) -> str:
    lines = ["name,x,y,z,strip" + (",omega,phi,kappa" if make.boresight_deg else "")]
    for name, center, R in zip(names, centers, rotations):
        at = center + R @ make.lever + make.shift.get(name[0], (0.0, 0.0, 0.0))
        fields = [name, *(f"{v:.5f}" for v in at), name[0]]
        if make.boresight_deg:
            seen = R @ rotation_from_angles(np.radians(make.boresight_deg))
            angles = angles_from_rotation(seen, make.rotation) * ANGLE_UNITS[make.unit] / (2 * np.pi)
            order = dict(zip(make.rotation, angles))
            fields += [f"{order[letter]:.9f}" for letter in "opk"]
        lines.append(",".join(fields))
    return "\n".join(lines) + "\n"


def _project(make: Make, names: tuple[str, ...], centers: NDArray[np.float64], camera: dict[str, Any]) -> Project:
    images: list[dict[str, Any]] = []
    for name in names:
        image: dict[str, Any] = {"name": name, "file": f"{name}.tif", "camera": "cam"}
        if camera["type"] == "film":
            image["fiducials"] = {
                n: [float(v) for v in FILM_TO_PIXEL @ [*xy, 1.0]] for n, xy in camera["fiducials_mm"].items()
            }
        images.append(image)
    return Project.model_validate({"crs": CRS, "cameras": {"cam": camera}, "images": images})


def _text(
    make: Make,
    true: Project,
    names: tuple[str, ...],
    centers: NDArray[np.float64],
    rotations: NDArray[np.float64],
    random: np.random.Generator,
) -> str:
    camera = {**make.camera, **make.stated}
    lines = [
        "# a remark that stays",
        f'crs = "{CRS}"',
        "[orientation]",
        'height_system = "ellipsoidal"',
        f'angle_unit = "{make.unit}"',
        f'rotation = "{make.rotation}"',
        f'earth_curvature = "{make.curvature}"',
        f"refraction = {toml_value(make.refraction)}",
        "[observations]",
        'image_points = ["points.csv"]',
        f"sigma_image = {make.sigma_image}",
    ]
    if make.control:
        lines += ['control = ["control.csv"]', "sigma_control = [0.01, 0.01]"]
    if make.positions:
        lines += ['positions = "positions.csv"', "sigma_position = [0.05, 0.05]"]
    if make.boresight_deg:
        lines.append("sigma_attitude = 0.01")
    drift = "shift" if make.shift else "none"
    lines += ["[adjustment]", f'drift = "{drift}"', f"boresight = {toml_value(make.boresight_deg is not None)}"]
    lines.append(f"lever_arm_sigma = {2.0 if any(make.lever) else 0.0}")
    lines += ["[cameras.cam]", *(f"{key} = {toml_value(value)}" for key, value in camera.items())]
    metres, degrees = make.start
    for name, center, R in zip(names, centers, rotations):
        lines += ["[[images]]", f'name = "{name}"', f'file = "{name}.tif"', 'camera = "cam"']
        if true.image(name).fiducials is not None:
            marks = {key: list(value) for key, value in (true.image(name).fiducials or {}).items()}
            lines.append(f"fiducials = {toml_value(marks)}")
        if np.isfinite(metres):
            near = center + random.normal(scale=metres, size=3)
            turn = rotation_from_angles(np.radians(random.normal(scale=degrees, size=3)))
            angles = angles_from_rotation(R @ turn, make.rotation) * ANGLE_UNITS[make.unit] / (2 * np.pi)
            lines += [f"center = {toml_value([float(v) for v in near])}"]
            lines += [f"angles = {toml_value([float(v) for v in angles])}"]
    return "\n".join(lines) + "\n"


def misses(made: Made, changed: Project, make: Make) -> NDArray[np.float64]:
    """Projected minus measured positions with the cameras of a changed project, (n, 2), pixels."""
    out = []
    measured = [line.split(",") for line in (made.path.parent / "points.csv").read_text().split("\n")[1:] if line]
    for name in made.names:
        image = changed.image(name)
        center, angles = image.pose_numbers
        unit = 2 * np.pi / ANGLE_UNITS[changed.orientation.angle_unit]
        pose = Pose.from_angles(center, np.array(angles) * unit, changed.orientation.rotation)
        camera = oriented_camera(
            interior_of(changed.cameras["cam"], image),
            lens_of(changed.cameras["cam"]),
            pose,
            crs=CRS,
            earth_curvature=make.curvature,
            refraction=make.refraction,
            mean_ground=GROUND,
        )
        own = [(point, float(x), float(y)) for point, file, x, y in measured if file == f"{name}.tif"]
        out.append(project(camera, np.array([made.points[point] for point, *_ in own])) - [xy for _, *xy in own])
    return np.concatenate(out)
