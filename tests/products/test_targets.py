"""Products on a wall and on a vault: two images of a surface behind a pillar, against rays that are traced."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import rasterio
from numpy.typing import NDArray
from rasterio.transform import from_origin
from scipy.ndimage import binary_dilation, binary_erosion
from tools.command import Said, inside

from photoplan.geometry.pose import angles_from_rotation
from photoplan.io.vector_layer import read_features

Array = NDArray[np.float64]
E, N, Z = 500_000.0, 5_300_000.0, 100.0
SIZE, CONSTANT = (480, 360), 420.0
PIXEL = 0.02
GREY = 12
"""Of the pillar: darker than all texture."""


def texture(u: Array, v: Array) -> Array:
    """Grey values of a surface, waves of 0.3 m and longer."""
    waves = np.sin(u * 9.0 + 0.7) * np.cos(v * 7.0) + np.sin(u * 21.0 + v * 13.0)
    return 130.0 + 40.0 * waves + 8.0 * u


@dataclass(frozen=True)
class Shot:
    """A photograph: where it was taken from, and at what."""

    center: tuple[float, float, float]
    at: tuple[float, float, float]
    gain: float = 1.0

    @property
    def rotation(self) -> Array:
        """Axes of the camera as columns; it looks against its third one."""
        back = np.subtract(self.center, self.at)
        back /= np.linalg.norm(back)
        right = np.cross((0.0, 0.0, 1.0), back)
        if np.linalg.norm(right) < 1e-6:
            right = np.array([1.0, 0.0, 0.0])
        right /= np.linalg.norm(right)
        return np.column_stack([right, np.cross(back, right), back])

    def rays(self) -> Array:
        """Directions of all pixels (height, width, 3)."""
        width, height = SIZE
        x, y = np.meshgrid(np.arange(width) - (width - 1) / 2, (height - 1) / 2 - np.arange(height))
        return np.stack([x, y, np.full_like(x, -CONSTANT)], axis=-1) @ self.rotation.T


@dataclass(frozen=True)
class Place:
    """A target, what stands before it, and the images of it; coordinates are counted from E, N, Z."""

    stated: str
    bounds: tuple[float, float, float, float]
    surface: Callable[[Array, Array], tuple[Array, Array, Array]]
    """Distance in lengths of rays at which they meet the surface (inf: never), and u, v there; of origins and rays."""
    ground: Callable[[Array, Array], Array]
    """Points of u, v on the surface."""
    pillar: tuple[tuple[float, float, float], tuple[float, float, float]]
    """Lowest and highest corner of a box."""
    shots: tuple[Shot, ...]

    def grid(self) -> tuple[Array, Array]:
        """u and v of the pixels of a product."""
        u0, v0, u1, v1 = self.bounds
        return np.meshgrid(np.arange(u0 + PIXEL / 2, u1, PIXEL), np.arange(v1 - PIXEL / 2, v0, -PIXEL))

    def sees(self, shot: Shot) -> NDArray[np.bool_]:
        """Pixels of a product that an image sees: nothing comes before them, and they face it."""
        XYZ = self.ground(*self.grid())
        way = XYZ - shot.center
        first = self.surface(np.broadcast_to(shot.center, way.shape), way)[0]
        clear = np.isinf(into_box(np.asarray(shot.center), way, self.pillar, 1.0)) & (first > 1 - 1e-6)
        p = way @ shot.rotation
        x, y = (CONSTANT * p[..., k] / -p[..., 2] for k in (0, 1))
        return clear & (p[..., 2] < 0) & (np.abs(x) < SIZE[0] / 2 - 3) & (np.abs(y) < SIZE[1] / 2 - 3)

    def photograph(self, shot: Shot) -> NDArray[np.uint8]:
        """Render an image, 3 × 3 rays a pixel."""
        rays, total = shot.rays(), np.zeros(SIZE[::-1])
        for dx in (-1, 0, 1):
            for dy in (-1, 0, 1):
                d = rays + shot.rotation @ (dx / 3, dy / 3, 0.0)
                t, u, v = self.surface(np.broadcast_to(shot.center, d.shape), d)
                seen = np.where(np.isfinite(t), texture(u, v) * shot.gain, 0.0)
                total += np.where(into_box(np.asarray(shot.center), d, self.pillar, np.inf) < t, GREY, seen)
        return np.clip(np.rint(total / 9), 0, 255).astype(np.uint8)


def into_box(origin: Array, d: Array, box: tuple[Sequence[float], Sequence[float]], end: float) -> Array:
    """Lengths of rays at which they enter a box before an end; inf where they do not."""
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = ((np.asarray(corner) - origin) / d for corner in box)
    near, far = np.fmax.reduce(np.fmin(a, b), axis=-1), np.fmin.reduce(np.fmax(a, b), axis=-1)
    return np.where((near <= far) & (near > 0) & (near < end), near, np.inf)


def wall() -> Place:
    """A wall of azimuth 180° (it faces south) through the origin, 4 m wide and 3 m high."""

    def met(origin: Array, d: Array) -> tuple[Array, Array, Array]:
        t = -origin[..., 1] / d[..., 1]
        t = np.where((t > 0) & (origin[..., 1] < 0), t, np.inf)
        at = origin + np.where(np.isfinite(t), t, 0.0)[..., None] * d
        return t, at[..., 0], at[..., 2]

    return Place(
        stated=f"wall:{E},{N},{Z},180",
        bounds=(-2.0, -1.5, 2.0, 1.5),
        surface=met,
        ground=lambda u, v: np.stack([u, np.zeros_like(u), v], axis=-1),
        pillar=((-0.15, -1.3, -2.0), (0.15, -1.0, 0.8)),
        shots=(Shot((-1.6, -5.0, 0.2), (-0.3, 0.0, 0.0)), Shot((1.5, -4.6, -0.3), (0.3, 0.0, 0.0), 0.85)),
    )


RADIUS = 3.0


def barrel() -> Place:
    """A vault of a radius about an axis to the north, seen from near its axis; u goes along the arc."""

    def met(origin: Array, d: Array) -> tuple[Array, Array, Array]:
        a, b = (d[..., (0, 2)] ** 2).sum(axis=-1), (origin[..., (0, 2)] * d[..., (0, 2)]).sum(axis=-1)
        c = (origin[..., (0, 2)] ** 2).sum(axis=-1) - RADIUS**2
        t = (-b + np.sqrt(np.maximum(b * b - a * c, 0.0))) / a
        at = origin + t[..., None] * d
        # From below u runs to the left of who looks north: to the west… where the axis points up in the product.
        return t, SIDE * RADIUS * np.arctan2(at[..., 0], at[..., 2]), at[..., 1]

    def ground(u: Array, v: Array) -> Array:
        angle = SIDE * u / RADIUS
        return np.stack([RADIUS * np.sin(angle), v, RADIUS * np.cos(angle)], axis=-1)

    return Place(
        stated=f"vault:{E},{N},{Z},0,{RADIUS}",
        bounds=(-2.0, -1.5, 2.0, 1.5),
        surface=met,
        ground=ground,
        pillar=((-0.2, -0.2, 1.2), (0.2, 0.2, 1.6)),
        shots=(Shot((-1.0, -0.6, -1.0), (0.1, 0.0, 3.0)), Shot((1.1, 0.5, -0.8), (-0.1, 0.0, 3.0), 0.85)),
    )


SIDE = -1.0


@dataclass(frozen=True)
class Made:
    place: Place
    path: Path


def write(place: Place, folder: Path) -> Made:
    """Write images, the pillar as a mesh, and the project."""
    images = []
    for number, shot in enumerate(place.shots):
        name = f"i{number}"
        with rasterio.open(folder / f"{name}.tif", "w", driver="GTiff", width=SIZE[0], height=SIZE[1], count=1,
                           dtype="uint8") as file:  # fmt: skip
            file.write(place.photograph(shot), 1)
        angles = np.degrees(angles_from_rotation(shot.rotation)).tolist()
        center = np.add(shot.center, (E, N, Z)).tolist()
        images.append(
            f'[[images]]\nname = "{name}"\nfile = "{name}.tif"\ncamera = "c"\ncenter = {center}\n'
            f"angles = {angles}\nsigma_center = [0.01, 0.01, 0.01]\nsigma_angles = [0.01, 0.01, 0.01]\n"
        )
    low, high = (np.add(corner, (E, N, Z)) for corner in place.pillar)
    corners = [[(low, high)[i >> k & 1][k] for k in range(3)] for i in range(8)]
    faces = [(1, 2, 4, 3), (5, 7, 8, 6), (1, 5, 6, 2), (3, 4, 8, 7), (1, 3, 7, 5), (2, 6, 8, 4)]
    (folder / "pillar.obj").write_text(
        "".join("v {} {} {}\n".format(*corner) for corner in corners)
        + "".join("f {} {} {} {}\n".format(*face) for face in faces)
    )
    path = folder / "project.toml"
    path.write_text(
        f'format = 1\ncrs = "EPSG:32633"\n[terrain]\nheight = {Z - 5}\nheight_system = "ellipsoidal"\n'
        '[orientation]\nheight_system = "ellipsoidal"\n'
        '[[objects]]\nfile = "pillar.obj"\ncrs = "EPSG:32633"\nheight_system = "same"\n'
        f"[cameras.c]\nsize = {list(SIZE)}\nfocal_px = {CONSTANT}\n" + "".join(images)
    )
    return Made(place, path)


@pytest.fixture(scope="module", params=[wall, barrel], ids=["wall", "vault"])
def made(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Made:
    return write(request.param(), tmp_path_factory.mktemp(request.param.__name__))


def run(verb: str, made: Made, *words: object) -> Said:
    said = inside(verb, made.path, "--target", made.place.stated, "--bounds", *made.place.bounds, *words)
    assert said.code == 0, said.err
    return said


def read(path: Path) -> NDArray[np.float64]:
    with rasterio.open(path) as file:
        assert file.crs is None
        return file.read(1, masked=True).astype(float).filled(np.nan)


def test_orthophotos_show_the_surface_and_leave_out_what_the_pillar_hides(made: Made, tmp_path: Path) -> None:
    run("ortho", made, "--resolution", PIXEL, "--hidden", "nodata", "--output", tmp_path)
    u, v = made.place.grid()
    for number, shot in enumerate(made.place.shots):
        found, sees = read(tmp_path / f"i{number}_ortho.tif"), made.place.sees(shot)
        shown, inner = np.isfinite(found), binary_erosion(sees, iterations=2)
        off = np.abs(found - shot.gain * texture(u, v))[inner]
        print(made.place.stated, number, "rms", np.sqrt(np.nanmean(off**2)), "apart", (shown ^ sees).mean())
        assert np.sqrt(np.mean(off**2)) < 1.0
        # Beside what hides and along the border of the image a pixel decides.
        assert not (shown & ~binary_dilation(sees, iterations=4)).any() and 0.4 < shown.mean() < 0.97
    with rasterio.open(tmp_path / "i0_ortho.tif") as file:
        assert file.tags()["PHOTOPLAN_TARGET"] == made.place.stated
        assert file.bounds == pytest.approx(made.place.bounds)


def test_a_mosaic_fills_what_one_image_does_not_see_from_the_other(made: Made, tmp_path: Path) -> None:
    words = ["--resolution", PIXEL, "--sources", "--accuracy", "--relief-sigma", 0.005, "--output", tmp_path]
    run("mosaic", made, *words)
    u, v = made.place.grid()
    found, owner = read(tmp_path / "mosaic.tif"), np.nan_to_num(read(tmp_path / "mosaic_sources.tif")).astype(int)
    seen = [made.place.sees(shot) for shot in made.place.shots]
    gain = np.array([np.nan, *(shot.gain for shot in made.place.shots)])[owner]
    for row, sees in enumerate(seen, 1):
        assert not ((owner == row) & ~binary_dilation(sees, iterations=4)).any()
        alone = binary_erosion(sees & ~seen[2 - row], iterations=4)
        assert alone.sum() > 300 and (owner[alone] == row).all()
    off = np.abs(found - gain * texture(u, v))[binary_erosion(seen[0] | seen[1], iterations=2) & (owner > 0)]
    print(made.place.stated, "rms", np.sqrt(np.mean(off**2)), "beyond 14:", (off > 14).mean())
    assert (off > 14).mean() < 0.004 and np.sqrt(np.mean(off[off < 14] ** 2)) < 1.0
    with rasterio.open(tmp_path / "mosaic_accuracy.tif") as file:
        sigma = file.read(masked=True).filled(np.nan)
    # Of the surface as stated; along u and v that, the standpoint and its angles, at five metres.
    assert np.nanmedian(sigma[2]) == pytest.approx(0.005, rel=0.01)
    assert 0.008 < np.nanmedian(sigma[0]) < 0.02 and 0.008 < np.nanmedian(sigma[1]) < 0.02
    assert len(read_features(tmp_path / "mosaic_seams.gpkg", "Polygon").items) >= 2


def test_seams_and_balance_join_two_exposures(made: Made, tmp_path: Path) -> None:
    run("seams", made, "--resolution", 2 * PIXEL, "--output", tmp_path / "seams.gpkg")
    regions = read_features(tmp_path / "seams.gpkg", "Polygon").items
    assert {feature.name for feature in regions} == {"i0", "i1"}
    u0, v0, u1, v1 = made.place.bounds
    for feature in regions:
        left, bottom, right, top = feature.shape.bounds
        assert u0 - 0.1 < left < right < u1 + 0.1 and v0 - 0.1 < bottom < top < v1 + 0.1
    said = run("balance", made, "--reference-image", "i0", "--resolution", 2 * PIXEL, "--degree", 0, "--json",
               "--output", tmp_path / "balance")  # fmt: skip
    found = json.loads(said.out)
    # A gain of 0.85 is 20 grey values; what is left is held down by what overlaps cannot determine.
    assert found["rms_before"][0] > 15 and found["rms_after"][0] < found["rms_before"][0] / 2


def test_an_object_is_shown_alone(made: Made, tmp_path: Path) -> None:
    said = inside("object", made.path, made.path.parent / "pillar.obj", "--target", made.place.stated, "--bounds",
                  *made.place.bounds, "--resolution", PIXEL, "--output", tmp_path)  # fmt: skip
    assert said.code == 0, said.err
    (path,) = tmp_path.glob("*_object.tif")
    found = read(path)
    shown = np.isfinite(found)
    assert shown.sum() > 200 and np.abs(found[binary_erosion(shown, iterations=3)] - GREY).max() < 3


def test_a_target_of_the_project_has_a_relief_of_its_own(made: Made, tmp_path: Path) -> None:
    """A raster of offsets that is flat gives the picture of the number, to the last bit; one over another wall is
    refused."""
    u0, v0, u1, v1 = made.place.bounds
    path = made.path.parent / "relief.tif"
    step = 0.25
    size = round((u1 - u0) / step), round((v1 - v0) / step)
    with rasterio.open(path, "w", driver="GTiff", width=size[0], height=size[1], count=1, dtype="float32",
                       transform=from_origin(u0, v1, step, step)) as file:  # fmt: skip
        file.write(np.full(size[::-1], 0.0, np.float32), 1)
        file.update_tags(PHOTOPLAN_TARGET=made.place.stated)
    project = made.path.with_name("named.toml")
    text = made.path.read_text()
    named = f'[targets.south]\nframe = "{made.place.stated}"\nrelief = "relief.tif"\n'
    project.write_text(text.replace("[cameras.c]", named + "[cameras.c]"))
    words = ("--images", "i0", "--resolution", PIXEL, "--hidden", "nodata", "--output")
    said = inside("ortho", project, "--target", "south", *words, tmp_path / "named")
    assert said.code == 0, said.err
    run("ortho", made, *words, tmp_path / "plain")
    named, plain = (read(tmp_path / name / "i0_ortho.tif") for name in ("named", "plain"))
    assert np.nanmax(np.abs(named - plain)) <= 1 and (np.isfinite(named) ^ np.isfinite(plain)).mean() < 0.001
    with rasterio.open(path, "r+") as file:
        file.update_tags(PHOTOPLAN_TARGET="wall:0,0,0,90")
    said = inside("ortho", project, "--target", "south", *words, tmp_path / "other")
    assert said.code == 3 and "its heights lie over wall:0,0,0,90, not over" in said.err, said.err


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("--target", "wall:500000,5300000,100,180"), "it has no end; set --bounds"),
        (("--relief", 1), "--relief and --relief-sigma require --target"),
        (("--target", "south"), "target south; give `map`, `wall:"),
        (("--target", "wall:500000,5300000,100,0", "--bounds", -2, -1, 2, 1), "it stands behind the target"),
        (("--target", "wall:500000,5300000,100,180", "--bounds", 2, -1, -2, 1), "are empty"),
    ],
)
def test_what_cannot_be_is_refused(words: tuple[object, ...], told: str, tmp_path: Path) -> None:
    made = write(wall(), tmp_path)
    said = inside("ortho", made.path, "--resolution", PIXEL, "--output", tmp_path / "o", *words)
    assert said.code in (2, 3, 4) and told in said.err, said.err


def test_a_plan_on_a_target_is_executed(made: Made, tmp_path: Path) -> None:
    run("mosaic", made, "--resolution", PIXEL, "--plan", tmp_path / "plan.gpkg", "--output", tmp_path / "planned")
    said = inside("run", tmp_path / "plan.gpkg")
    assert said.code == 0, said.err
    run("mosaic", made, "--resolution", PIXEL, "--output", tmp_path / "direct")
    a, b = (read(tmp_path / name / "mosaic.tif") for name in ("planned", "direct"))
    assert np.array_equal(a, b, equal_nan=True)
