"""Blocks of a camera whose lens is not known yet: no image is lost to it, and no control that nothing contradicts."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from photoplan.products.adjust.run import AdjustReport, AdjustRequest, adjust_project

FOCAL, SIZE, IMAGES = 2336.0, (2272, 1704), 6
#: Of a board of 7 × 7 targets, one metre wide.
CORNERS = (0, 6, 42, 48)


def board(folder: Path, raised: float = 0.0, calibrate: str = '"c", "x0", "y0", "k1", "k2"') -> Path:
    """Six images around the board, by a lens of 25 %; the last shows a part of it, beside the middle."""
    rng = np.random.default_rng(1)
    side = np.linspace(0.0, 1.0, 7)
    X = np.array([(x, y, 0.02 * rng.normal()) for x in side for y in side])
    rows = ["point,image,x,y"]
    for i in range(IMAGES):
        turn = 2 * np.pi * i / IMAGES
        center = np.array([0.5, 0.5, 0.0]) + 1.9 * np.array(
            [np.sin(0.6) * np.cos(turn), np.sin(0.6) * np.sin(turn), np.cos(0.6)]
        )
        z = center - (0.5 if i < IMAGES - 1 else 1.0, 0.5, 0.0)
        z /= np.linalg.norm(z)
        x = np.cross([0.0, 1.0, 0.01], z)
        x /= np.linalg.norm(x)
        c, s = np.cos(i * np.pi / 2), np.sin(i * np.pi / 2)
        p = (X - center) @ np.column_stack([x, np.cross(z, x), z]) @ [[c, -s, 0], [s, c, 0], [0, 0, 1]]
        u = -p[:, :2] / p[:, 2:]
        r2 = (u**2).sum(axis=1, keepdims=True)
        xy = np.array([FOCAL, -FOCAL]) * u * (1 - 0.25 * r2 + 0.3 * r2**2) + ((SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2)
        seen = ((xy > 0) & (xy < np.subtract(SIZE, 1))).all(axis=1)
        xy += rng.normal(0, 0.1, xy.shape)
        rows += [f"P{k},im{i},{xy[k, 0]:.3f},{xy[k, 1]:.3f}" for k in np.flatnonzero(seen)]
    (folder / "points.csv").write_text("\n".join(rows) + "\n")
    X[48, 2] += raised
    control = [f"P{k},{X[k, 0]:.5f},{X[k, 1]:.5f},{X[k, 2]:.5f}" for k in CORNERS]
    (folder / "control.csv").write_text("\n".join(["name,x,y,z", *control]) + "\n")
    images = "".join(f'[[images]]\nname = "im{i}"\nfile = "im{i}.tif"\ncamera = "cam"\n' for i in range(IMAGES))
    (folder / "project.toml").write_text(
        f"""crs = "EPSG:32633"
[orientation]
height_system = "ellipsoidal"
[observations]
image_points = ["points.csv"]
control = ["control.csv"]
sigma_image = 0.1
sigma_control = [0, 0]
[adjustment]
calibrate = {{ cam = [{calibrate}] }}
[cameras.cam]
type = "frame"
size = [{SIZE[0]}, {SIZE[1]}]
focal_px = 2350
lens = {{ type = "brown" }}
{images}"""
    )
    return folder / "project.toml"


def _adjusted(path: Path, *, robust: bool) -> AdjustReport:
    return adjust_project(AdjustRequest(path, robust=robust, correlation=False, dry_run=True))


def test_images_that_only_the_calibrated_lens_fits_take_part(tmp_path: Path) -> None:
    found = _adjusted(board(tmp_path), robust=False)
    assert len(found.images) == IMAGES
    assert found.left_out == ()
    assert 0.9 < found.sigma0 < 1.1
    np.testing.assert_allclose(found.cameras[0].after[0], FOCAL, atol=4 * found.cameras[0].sigma[0])


def test_without_calibration_the_reason_is_the_right_one(tmp_path: Path) -> None:
    found = _adjusted(board(tmp_path, calibrate=""), robust=False)
    reasons = dict(found.not_oriented)
    what = "are known from other images, but no orientation makes enough of them fit: are camera constant"
    assert what in reasons["im5"]


def test_where_nothing_tells_which_control_is_wrong_all_of_it_stays(tmp_path: Path) -> None:
    """Four fixed corners, one of them raised by 5 mm: every three of them agree."""
    found = _adjusted(board(tmp_path, raised=0.005), robust=True)
    notes = " ".join(found.notes)
    assert "control points contradict each other, and nothing tells which is wrong" in notes
    assert not any(any(point.rejected) for point in found.ground)
