"""What a project file keeps of the accuracy of its images, and what becomes of it."""

from __future__ import annotations

import numpy as np
import pytest
import rasterio
from tools.adjust_project import Make, write_project
from tools.command import inside
from tools.small_model import CRS, write_small

from photoplan.cameras.base import project
from photoplan.cameras.frame import FrameCamera
from photoplan.cameras.lenses import Brown, Interior
from photoplan.errors import InputError
from photoplan.geometry.grid import MapGrid
from photoplan.geometry.pose import Pose
from photoplan.io.project.file import load_project, parse_project
from photoplan.io.project.model import StatedTerrain
from photoplan.io.terrain.model import ModelReader
from photoplan.orientation.bundle.model import AdjustSettings
from photoplan.products.adjust.inputs import adjust_prepared, map_result, prepare, read_inputs, started, stated_accuracy
from photoplan.project.cameras import camera_without_pixels
from photoplan.project.error_model import ScenesErrors, height_errors, source_errors
from photoplan.project.ground import ground_of
from photoplan.project.scene import ScenesAddress, input_files
from photoplan.surfaces.hybrid import HybridSurface, StatedHeightErrors
from photoplan.targets.map import MapTarget


def write_heights(path, values: np.ndarray) -> None:
    """A raster of 2 m pixels."""
    profile = {"driver": "GTiff", "dtype": "float32", "count": 1, "crs": "EPSG:32633"}
    place = rasterio.Affine(2.0, 0.0, 500_000.0, 0.0, -2.0, 5_300_000.0)
    height, width = values.shape
    with rasterio.open(path, "w", **profile, width=width, height=height, transform=place) as file:
        file.write(values, 1)


CENTER, ANGLES = np.array([400_000.0, 5_200_000.0, 1500.0]), np.array([2.0, -3.0, 100.0])
SIZE, FOCAL, K1 = (4000, 3000), 3600.0, -0.05
XYZ = CENTER + np.array([(300.0, 200, -1500), (-500, 400, -1450), (0, 0, -1480)])


def project_with(tmp_path, image: dict, camera: dict | None = None, terrain: dict | None = None):
    return parse_project(
        {
            "format": 1,
            "crs": "EPSG:32633",
            "terrain": {"height": 0.0, "height_system": "same", **(terrain or {})},
            "orientation": {"height_system": "EPSG:5773", "angle_unit": "gon", "rotation": "opk"},
            "cameras": {
                "c": {
                    "type": "frame",
                    "size": list(SIZE),
                    "focal_px": FOCAL,
                    "lens": {"type": "brown", "k1": K1},
                    **(camera or {}),
                }
            },
            "images": [
                {"name": "a", "file": "a.tif", "camera": "c", "center": [*CENTER], "angles": [*ANGLES], **image}
            ],
        },
        tmp_path,
        "project",
    )


def camera_at(change: np.ndarray) -> FrameCamera:
    """The camera of the project with other X0, Y0, Z0, ω, φ, κ (gon), c, x0, y0 (pixels), k1."""
    pose = Pose.from_angles(CENTER + change[:3], np.radians(0.9 * (ANGLES + change[3:6])))
    interior = Interior.digital(SIZE, (FOCAL + change[6],) * 2, (change[7], change[8]))
    return FrameCamera(interior, Brown(k1=K1 + change[9]), pose)


def image_covariance(covariance: np.ndarray) -> np.ndarray:
    """Covariances (n, 2, 2) of image points by central differences of the camera itself."""
    steps = 0.01 * np.sqrt(np.diag(covariance)) + 1e-300
    J = [
        (project(camera_at(h * e), XYZ) - project(camera_at(-h * e), XYZ)) / (2 * h) for e, h in zip(np.eye(10), steps)
    ]
    D = np.stack(J, axis=-1)
    return D @ covariance @ np.swapaxes(D, 1, 2)


def joint_covariance() -> np.ndarray:
    """Position and angles nearly make up for each other, as in every block."""
    rng = np.random.default_rng(4)
    sigma = np.array([0.3, 0.4, 0.1, 0.015, 0.012, 0.003, 2.0, 1.5, 1.0, 2e-4])
    L = np.eye(10) + np.tril(rng.normal(0, 0.2, (10, 10)), -1)
    L[4, 0], L[3, 1] = 30.0, -30.0
    R = L @ L.T
    d = np.sqrt(np.diag(R))
    return R / np.outer(d, d) * np.outer(sigma, sigma)


@pytest.mark.parametrize("count", [6, 10])
def test_what_is_written_is_what_counts(tmp_path, count: int) -> None:
    covariance = np.zeros((10, 10))
    covariance[:count, :count] = joint_covariance()[:count, :count]
    entries = stated_accuracy(covariance[:count, :count])
    sigma = dict(zip(("c", "x0", "y0", "k1"), np.sqrt(np.diag(covariance))[6:].tolist()))
    loaded = project_with(tmp_path, entries, {"sigma": sigma} if count > 6 else None)
    errors = source_errors(loaded, loaded.images[0], ground_of(loaded), camera_at(np.zeros(10)), 0.0)
    D = np.stack([cause.displacement(XYZ) for cause in errors.causes], axis=-1)
    np.testing.assert_allclose(D @ np.swapaxes(D, 1, 2), image_covariance(covariance), rtol=2e-3, atol=1e-3)


def test_uncorrelated_errors_have_names(tmp_path) -> None:
    stated = {"sigma_center": [0.1, 0.2, 0.3], "sigma_angles": [0.01, 0.02, 0.03]}
    loaded = project_with(tmp_path, stated, {"sigma": {"c": 2.0, "k1": 1e-4}})
    errors = source_errors(loaded, loaded.images[0], ground_of(loaded), camera_at(np.zeros(10)), 0.0)
    names = {cause.name for cause in errors.causes}
    assert names == {"X0", "Y0", "Z0", "omega", "phi", "kappa", "camera c", "camera k1"}
    D = np.stack([cause.displacement(XYZ) for cause in errors.causes], axis=-1)
    sigma = np.array([0.1, 0.2, 0.3, 0.01, 0.02, 0.03, 2.0, 0.0, 0.0, 1e-4])
    np.testing.assert_allclose(D @ np.swapaxes(D, 1, 2), image_covariance(np.diag(sigma**2)), rtol=1e-3, atol=1e-6)


def test_what_is_not_known_is_said(tmp_path) -> None:
    loaded = project_with(tmp_path, {})
    with pytest.raises(InputError, match=r"'a'.*photoplan adjust.*sigma_center"):
        source_errors(loaded, loaded.images[0], ground_of(loaded), camera_at(np.zeros(10)), 0.0)
    with pytest.raises(InputError, match=r"sigma = METRES in \[terrain\]"):
        height_errors(loaded)
    stated = {"sigma_center": [0.1, 0.2, 0.3], "sigma_angles": [0.01, 0.02, 0.03]}
    for image, camera, match in (
        ({**stated, "correlation": [0.0] * 14}, None, "14 numbers; 15"),
        ({**stated, "correlation": [1.0, 1.0, -1.0, *[0.0] * 12]}, None, "no covariance"),
        (stated, {"sigma": {"k9": 1.0}}, "'k9'"),
    ):
        loaded = project_with(tmp_path, image, camera)
        with pytest.raises(InputError, match=match):
            source_errors(loaded, loaded.images[0], ground_of(loaded), camera_at(np.zeros(10)), 0.0)
    with pytest.raises(InputError, match="correlation goes with"):
        project_with(tmp_path, {"correlation": [0.0] * 15})


def test_terrain_states_its_own(tmp_path) -> None:
    assert height_errors(project_with(tmp_path, {}, terrain={"sigma": 0.25})) == StatedHeightErrors(0.25)
    write_small(tmp_path / "model.gpkg")
    loaded = project_with(tmp_path, {})
    target = MapTarget(MapGrid(500_000.0, 5_300_000.0, 2.0, 20, 20, CRS))
    of_file = StatedTerrain(file="model.gpkg", height_system="same")
    own = height_errors(loaded.model_copy(update={"terrain": of_file}))(target, target.window)
    surface = HybridSurface(ModelReader(tmp_path / "model.gpkg"))
    np.testing.assert_array_equal(own, surface.relief_with_sigma(target, target.window)[1])
    assert own.min() >= 0.05 and own.max() < 0.06  # posts of the model, and what is between them
    stated = height_errors(loaded.model_copy(update={"terrain": of_file.model_copy(update={"sigma": 0.3})}))
    assert (stated(target, target.window) == 0.3).all()


def test_terrain_states_a_raster_of_its_own(tmp_path) -> None:
    """Bilinear between its pixels; where it tells nothing, nothing is known; its content is part of the key."""
    path = tmp_path / "sigma.tif"
    values = np.linspace(0.1, 0.4, 30, dtype=np.float32)[None] + np.zeros((25, 1), np.float32)
    values[:5] = -1.0
    write_heights(path, values)
    loaded = project_with(tmp_path, {}, terrain={"sigma": "sigma.tif"})
    errors = height_errors(loaded)
    XY = np.array([(500_010.0, 5_299_970.0), (500_031.0, 5_299_960.0), (500_010.0, 5_299_997.0), (0.0, 0.0)])
    expected = np.interp(XY[:, 0], 500_001.0 + 2.0 * np.arange(30), values[-1])
    np.testing.assert_allclose(errors.sigmas(XY), np.where([1, 1, 0, 0], expected, np.nan), rtol=1e-6)
    target = MapTarget(MapGrid(500_000.0, 5_300_000.0, 1.0, 60, 50, "EPSG:32633"))
    relief = errors(target, target.window)
    v, u = np.mgrid[12:49, 1:59]
    np.testing.assert_allclose(
        relief[12:49, 1:59], errors.sigmas(np.stack([500_000.5 + u, 5_299_999.5 - v], axis=-1)), rtol=1e-5
    )
    assert np.isnan(relief[:8]).all()
    stated = {"sigma_center": [0.1, 0.2, 0.3], "sigma_angles": [0.01, 0.02, 0.03]}
    write_heights(tmp_path / "a.tif", np.zeros(SIZE[::-1], np.float32))
    project = project_with(tmp_path, stated, terrain={"sigma": "sigma.tif"})
    assert path in input_files(project)
    before = ScenesErrors(ScenesAddress.of(project, ("a",)), (0.5,)).facts
    write_heights(path, values + np.float32(0.01))
    assert ScenesErrors(ScenesAddress.of(project, ("a",)), (0.5,)).facts != before
    (tmp_path / "text.tif").write_text("no raster")
    for wrong in ("none.tif", "text.tif"):
        with pytest.raises(InputError, match=wrong):
            height_errors(project_with(tmp_path, {}, terrain={"sigma": wrong}))


def test_of_an_adjusted_project_with_a_calibrated_camera(tmp_path) -> None:
    """What the file says is the covariance of the adjustment, at points on the ground, up to its written digits."""
    pytest.importorskip("matplotlib")
    made = write_project(tmp_path / "block", Make(pixel_noise=0.3))
    adjusted = load_project(made.path)
    inputs, starts = started(read_inputs(adjusted, adjusted.select()))
    free = {"cam": {"c": None, "x0": None}}
    result = map_result(*adjust_prepared(prepare(inputs, starts, free), AdjustSettings(robust=False)))
    assert inside("adjust", made.path, "--calibrate", "cam=c,x0", "--no-robust").code == 0
    terrain = StatedTerrain(height=0.0, height_system="same")
    loaded = load_project(made.path).model_copy(update={"terrain": terrain})
    assert set(loaded.cameras["cam"].sigma or ()) == {"c", "x0"}
    points = np.array([XYZ for name, XYZ in made.points.items() if name.startswith("G")])
    for k, name in enumerate(result.adjusted.images):
        image = loaded.image(name)
        sigma = np.sqrt(np.diag(result.covariances[k]))
        np.testing.assert_allclose([*image.sigma_center, *image.sigma_angles], sigma[:6], rtol=1e-4)
        R = result.covariances[k] / np.outer(sigma, sigma)
        np.testing.assert_allclose(image.correlation, R[np.tril_indices(8, -1)], atol=1e-6)
        together, alone = (
            np.sqrt(
                sum(
                    np.square(cause.displacement(points)).sum(axis=1)
                    for cause in source_errors(
                        loaded, each, ground_of(loaded), camera_without_pixels(loaded, name), 0.0
                    ).causes
                )
            )
            for each in (image, image.model_copy(update={"correlation": None}))
        )
        # One by one they would be many times as large: they make up for each other.
        assert (together < 1.0).sum() > 3 and np.nanmin(together / alone) < 0.2
