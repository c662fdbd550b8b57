"""Accuracy rasters of images with rational polynomials, from the covariance of their correction."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rasterio
from test_satellite_faults import PIXEL, SIZE, edited, refused, small, written
from tools.command import inside
from tools.rpc_images import CRS

from photoplan.cameras.rpc import RpcCamera
from photoplan.geometry.local import GeodeticGround


def accuracy_of(project: Path) -> tuple[np.ndarray, rasterio.Affine]:
    said = inside("ortho", project, "--resolution", PIXEL, "--no-quicklook", "--accuracy")
    assert said.code == 0, said.err
    with rasterio.open(next(project.parent.glob("products/*accuracy*.tif"))) as file:
        return file.read().astype(float), file.transform


def known(folder: Path, covariance: str) -> Path:
    """A project with terrain known to a millimetre, and this covariance of the correction."""
    project = edited(written(folder), "[terrain]", "[terrain]\nsigma = 0.001")
    return edited(project, 'rpc = "rpc.txt"', f'rpc = "rpc.txt"\nshift = [0.4, -0.3]\n{covariance}')


def test_the_covariance_of_a_shift_is_carried_to_the_ground(tmp_path: Path) -> None:
    """2 px along the columns, 1 px along the rows, correlated: as the camera's derivatives carry them."""
    C = np.array([[4.0, 0.8], [0.8, 1.0]])
    found, T = accuracy_of(known(tmp_path, f"covariance = [{C[0, 0]}, {C[1, 0]}, {C[1, 1]}]"))
    row, col = found.shape[1] // 2, found.shape[2] // 2
    X, Y = T @ (col + 0.5, row + 0.5)
    camera = RpcCamera(small(), GeodeticGround(CRS, "ellipsoidal"), SIZE)
    inverse = np.linalg.inv(camera.derivatives(np.array([[X, Y, 300.0]]))[0, :, :2])
    ground = inverse @ C @ inverse.T
    assert np.allclose(found[:2, row, col], np.sqrt(np.diag(ground)), rtol=0.02)
    assert np.allclose(found[3, row, col] ** 2 + found[4, row, col] ** 2, np.trace(ground), rtol=0.03)


def test_a_drift_makes_it_worse_towards_the_border(tmp_path: Path) -> None:
    """0.1 px of shift at the first pixel, 0.05 px for each row of 80."""
    variances = [0.01, 0.01, 0.0, 0.0025, 0.0, 0.0]
    triangle = [variances[i] if i == j else 0.0 for i in range(6) for j in range(i + 1)]
    found, _ = accuracy_of(known(tmp_path, f"covariance = {triangle}"))
    column = found[0][:, found.shape[2] // 2]
    seen = np.flatnonzero(np.isfinite(column) & (column > 0))
    assert column[seen[-3]] > 8 * column[seen[2]]


@pytest.mark.parametrize(
    ("covariance", "told"),
    [
        ("", "adjust"),
        ("covariance = [1.0, 3.0, 1.0]", "covariance is none"),
        ("covariance = [1e14, 0.0, 1e14]", "± 1e+07 px"),
    ],
    ids=["unknown", "none", "absurd"],
)
def test_what_is_not_known_is_said(tmp_path: Path, covariance: str, told: str) -> None:
    words = ("--resolution", PIXEL, "--no-quicklook", "--accuracy")
    said = refused("ortho", known(tmp_path, covariance), *words)
    assert "'a'" in said and told in said
