"""Readings of an orientation table: the true one is found among all, and what the points cannot tell is said."""

from itertools import product
from pathlib import Path

import numpy as np
import pytest
import rasterio
from pyproj import Transformer

from photoplan.cameras.base import project
from photoplan.cameras.frame import FrameCamera
from photoplan.cameras.lenses import Brown, Interior, NoLens
from photoplan.cameras.observed import GroundPoints, ImagePoints
from photoplan.errors import GeometryError, InputError
from photoplan.geometry.pose import ANGLE_UNITS, ROTATION_ORDERS, Pose, angles_from_rotation, rotation_from_angles
from photoplan.io.formats import read_orientation
from photoplan.io.orientation.block import TableFormat
from photoplan.io.points import read_ground_points, read_image_points
from photoplan.orientation.conventions import (
    CAMERA_AXES,
    DIRECTIONS,
    TURNS,
    Convention,
    StatedPoses,
    fitting,
    judge_conventions,
    sights_of,
    turn_matrix,
)

SIZE = (6000, 4000)
ORIGIN = np.array([500_000.0, 5_200_000.0])
LENS = Brown(k1=-0.05)


def made_block(mirrored=False, images=8, lens=LENS, sigma=0.3, seed=4):
    """Poses with tilts of some degrees, and measured image points of ground points they see."""
    rng = np.random.default_rng(seed)
    interior = Interior.digital(SIZE, (7000.0, 7000.0), (12.0, -7.0))
    centers = np.column_stack([rng.uniform(500, 900, (images, 2)) + ORIGIN, rng.uniform(900, 1000, images)])
    # Images look in all directions of the compass, as in a block of several strips.
    angles = np.radians(np.column_stack([rng.uniform(-8, 8, (images, 2)), rng.uniform(-180, 180, images)]))
    R = np.stack([rotation_from_angles(a) for a in angles])
    XYZ = np.column_stack([rng.uniform(200, 1200, (400, 2)) + ORIGIN, rng.uniform(200, 300, 400)])
    rows = []
    for k in range(images):
        xy = project(FrameCamera(interior, lens, Pose(centers[k], R[k])), XYZ) + rng.normal(0, sigma, (400, 2))
        for p in np.flatnonzero((xy >= 0).all(axis=1) & (xy < SIZE).all(axis=1))[:12]:
            # A mirrored scan: columns counted from the other side of the principal point.
            col = 2 * ((SIZE[0] - 1) / 2 + 12.0) - xy[p, 0] if mirrored else xy[p, 0]
            rows.append((f"p{p}", f"i{k}", col, xy[p, 1]))
    observed = ImagePoints.from_rows(rows)
    ground = GroundPoints(tuple(f"p{k}" for k in range(400)), XYZ, np.full((400, 3), np.nan), np.zeros(400, bool))
    cameras = {f"i{k}": (interior, lens) for k in range(images)}
    return tuple(cameras), centers, R, cameras, observed, ground


def stated(names, centers, R, reading):
    """The numbers that a file holds which is to be read so."""
    F = turn_matrix(reading.camera_axes, reading.turned)
    M = R @ F  # from the axes that the file means to ours and on to the ground
    M = M if reading.direction == "camera-to-ground" else np.swapaxes(M, 1, 2)
    angles = np.array([angles_from_rotation(m, reading.rotation) for m in M]) * (
        ANGLE_UNITS[reading.angle_unit] / (2 * np.pi)
    )
    at = [reading.rotation.index(letter) for letter in "opk"]
    return StatedPoses(names, centers[:, [1, 0, 2]] if reading.swapped else centers, angles=angles[:, at])


SOME = [
    Convention(unit, order, direction, axes, turned, mirrored, swapped)
    for k, (unit, order, direction, axes, turned, mirrored, swapped) in enumerate(
        product(ANGLE_UNITS, ROTATION_ORDERS, DIRECTIONS, CAMERA_AXES, TURNS, (False, True), (False, True))
    )
    if k % 67 == 0
]


@pytest.mark.parametrize("reading", SOME, ids=lambda r: f"{r.angle_unit}-{r.rotation}-{r.direction[:3]}-{r.turned}")
def test_the_true_reading_is_the_only_one_that_fits(reading):
    names, centers, R, cameras, observed, ground = made_block(reading.mirrored)
    sights = sights_of(names, cameras, observed, ground)
    results = judge_conventions(stated(names, centers, R, reading), sights)
    assert len(results) == 3 * 6 * 2 * 2 * 4 * 2 * 2
    fits = fitting(results)
    assert fits[0].reading == reading
    # The median length of two normal errors of 0.3 px is 0.3 · √(2 ln 2) px.
    assert fits[0].median == pytest.approx(0.3 * np.sqrt(2 * np.log(2)), rel=0.25)
    assert all(r.median > 1.5 * fits[0].median for r in results if r not in fits)


def test_the_lens_is_taken_into_account():
    names, centers, R, cameras, observed, ground = made_block()
    without = {name: (interior, NoLens()) for name, (interior, _) in cameras.items()}
    poses = stated(names, centers, R, Convention())
    assert judge_conventions(poses, sights_of(names, cameras, observed, ground))[0].median < 0.5
    assert judge_conventions(poses, sights_of(names, without, observed, ground))[0].median > 5


def test_fault_17_a_third_of_gross_errors_does_not_decide():
    names, centers, R, cameras, observed, ground = made_block()
    rng = np.random.default_rng(0)
    xy = observed.xy.copy()
    bad = rng.random(len(xy)) < 0.33
    xy[bad] = rng.uniform(0, SIZE, (int(bad.sum()), 2))
    spoiled = ImagePoints(observed.images, observed.points, observed.image, observed.point, xy, observed.sigma)
    results = judge_conventions(
        stated(names, centers, R, Convention("gon", "kpo")), sights_of(names, cameras, spoiled, ground)
    )
    assert [f.reading for f in fitting(results)] == [Convention("gon", "kpo")]


def test_matrices_have_a_direction_and_axes_only():
    names, centers, R, cameras, observed, ground = made_block()
    sights = sights_of(names, cameras, observed, ground)
    results = judge_conventions(StatedPoses(names, centers, matrices=np.swapaxes(R, 1, 2)), sights)
    assert len(results) == 2 * 2 * 4 * 2 * 2
    assert [f.reading for f in fitting(results)] == [Convention(direction="ground-to-camera")]


def test_strictly_vertical_images_do_not_tell_orders_and_that_is_said():
    names, centers, _, cameras, _, ground = made_block()
    interior = next(iter(cameras.values()))[0]
    kappa = np.linspace(-3, 3, len(names))
    R = np.stack([rotation_from_angles((0, 0, k)) for k in kappa])
    rows = []
    for k, name in enumerate(names):
        xy = project(FrameCamera(interior, LENS, Pose(centers[k], R[k])), ground.XYZ)
        rows += [(f"p{p}", name, *xy[p]) for p in range(0, 400, 50)]
    sights = sights_of(names, cameras, ImagePoints.from_rows(rows), ground)
    fits = fitting(judge_conventions(stated(names, centers, R, Convention()), sights))
    assert {f.reading.rotation for f in fits} == set(ROTATION_ORDERS)
    # Of equals the simplest is first.
    assert fits[0].reading == Convention()


def test_too_few_points_and_cameras_that_see_nothing():
    names, centers, _, cameras, observed, ground = made_block()
    with pytest.raises(InputError, match=r"2 image points are of ground points .* at least 3"):
        sights_of(names, cameras, observed.where(np.arange(2)), ground)
    with pytest.raises(InputError, match="0 image points"):
        sights_of(("x",), {"x": cameras["i0"]}, observed, ground)
    no_height = GroundPoints(ground.names, ground.XYZ * [1, 1, np.nan], ground.sigma, ground.check)
    with pytest.raises(InputError, match="0 image points"):
        sights_of(names, cameras, observed, no_height)
    sights = sights_of(names, cameras, observed, ground)
    with pytest.raises(GeometryError, match="under no reading"):
        judge_conventions(StatedPoses(names, np.full_like(centers, np.nan), angles=np.zeros((len(names), 3))), sights)


@pytest.fixture(scope="module")
def borea(shared: Path):
    """The real block of 805 exposures: centres with ellipsoidal heights, rotations, sights."""
    folder = shared / "data" / "ign_borea"
    table = read_orientation(folder / "23FD1305_alt_2.OPK")
    lon, lat = Transformer.from_crs("EPSG:2154", "EPSG:4171", always_xy=True).transform(*table.centers[:, :2].T)
    with rasterio.open(folder / "fr_ign_RAF20.tif") as raster:
        undulation = np.array([v[0] for v in raster.sample(zip(lon, lat))])
    centers = table.centers + np.column_stack([np.zeros((len(undulation), 2)), undulation])
    interior = Interior.digital((26460, 17004), (30975.0, 30975.0), (13210.0 - 13229.5, 8502.0 - 8501.5))
    names = tuple(i.name for i in table.images)
    observed = read_image_points(folder / "all_liaisons2.mes")
    ground = read_ground_points(folder / "all_liaisons2_world.mes", columns="name,x,y,z")
    sights = sights_of(names, dict.fromkeys(names, (interior, NoLens())), observed, ground)
    return names, centers, table, sights


def test_ign_borea_true_reading_is_first_by_a_wide_margin(borea):
    names, centers, table, sights = borea
    angles = np.array([i.angles for i in table.images])
    results = judge_conventions(StatedPoses(names, centers, angles=angles), sights)
    assert len(sights.image) == 14_407
    assert results[0].reading == Convention()
    assert results[0].median < 0.3
    # Tilts are below half a degree: φ before ω or after it differs by hundredths of a pixel. Everything else is wrong.
    assert {f.reading for f in fitting(results)} <= {Convention(), Convention(rotation="pok")}
    others = [r for r in results if r.reading.rotation not in ("opk", "pok") or r.reading.angle_unit != "deg"]
    assert min(r.median for r in others) > 2 * results[0].median
    assert min(r.median for r in results if r.reading.angle_unit != "deg") > 60 * results[0].median
    other_way = [r for r in results if r.reading.direction != "camera-to-ground" or r.reading.turned]
    assert min(r.median for r in other_way) > 500 * results[0].median


def test_ign_borea_scrambled_table_is_recognised(borea):
    names, centers, table, sights = borea
    true = Convention("gon", "kpo", "ground-to-camera")
    results = judge_conventions(stated(names, centers, table.rotations, true), sights)
    assert results[0].reading == true
    assert results[0].median < 0.3
    assert {f.reading for f in fitting(results)} <= {true, Convention("gon", "kop", "ground-to-camera")}


def test_ign_borea_columns_in_another_order_are_no_other_rotation(shared, borea):
    """The small file states φ before ω: columns, not the order of rotations."""
    _, _, table, _ = borea
    columns = "name=NOM,x=X,y=Y,z=Z,omega=O,phi=P,kappa=K"
    other = read_orientation(shared / "data" / "ign_borea" / "23FD1305_alt_NCPOKXYZ.OPK", TableFormat(columns=columns))
    by_name = {i.name: i for i in table.images}
    known = [image for image in other.images if image.name in by_name]
    assert (len(other.images), len(known)) == (7, 5)
    for image in known:
        assert image.angles == by_name[image.name].angles
        assert image.center == by_name[image.name].center
