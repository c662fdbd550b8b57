"""The real UltraCam block through `photoplan adjust`: 805 exposures from noisy orientations.

Sixty-eight of the exposures have measured points; the others are held by their positions and attitudes alone.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from tools.command import peak_of
from tools.ign_block import Published, ign_project, published
from tools.kept import kept

from photoplan.geometry.pose import rotation_opk
from photoplan.io.points import read_image_points
from photoplan.io.project.file import load_project

GIB = 2**30


@pytest.fixture(scope="module")
def block(shared: Path) -> tuple[dict, Path, int, Published]:
    data = shared / "data" / "ign_borea"

    def make(folder: Path) -> None:
        said, peak = peak_of("adjust", ign_project(folder, data, position_noise=0.1, attitude_noise_deg=0.01), "-q")
        assert said.code == 0, said.err
        (folder / "peak.txt").write_text(str(peak))

    folder = kept("ign-block", make, ["photoplan.products.adjust.run"], [data])
    report = json.loads((folder / "adjustment" / "report.json").read_text())
    return report, folder / "project.toml", int((folder / "peak.txt").read_text()), published(data)


def deviations(project: Path, truth: Published) -> tuple[np.ndarray, np.ndarray]:
    """Adjusted minus published centres and small rotations in units of their standard deviations, (805, 6).

    The datum, a similarity of all projection centres, is taken out first. Second: which images have measured points.
    """
    images = {image.name: image for image in load_project(project).images}
    chosen = [images[name] for name in truth.names]
    centers = np.array([i.center for i in chosen])
    R = np.array([rotation_opk(*np.radians(i.angles)) for i in chosen])
    true = np.array([rotation_opk(*np.radians(a)) for a in truth.angles])
    a, b = centers - centers.mean(axis=0), truth.centers - truth.centers.mean(axis=0)
    U, s, Vt = np.linalg.svd(b.T @ a)
    D = np.diag([1.0, 1.0, np.linalg.det(U @ Vt)])
    turn, scale = U @ D @ Vt, (s * np.diag(D)).sum() / (a**2).sum()
    off = scale * a @ turn.T - b
    rotated = np.swapaxes(true, 1, 2) @ (turn @ R)
    small = np.stack([rotated[:, 2, 1], rotated[:, 0, 2], rotated[:, 1, 0]], axis=1)
    # The angles' deviations in the angles themselves: the block is nearly vertical, ω and φ are turned by κ.
    kappa = np.radians(truth.angles[:, 2])
    c, k = np.cos(kappa), np.sin(kappa)
    small = np.stack([c * small[:, 0] - k * small[:, 1], k * small[:, 0] + c * small[:, 1], small[:, 2]], axis=1)
    sigma = np.array([[*i.sigma_center, *np.radians(i.sigma_angles)] for i in chosen])
    measured = set(read_image_points(project.parent / "image_points.csv").images)
    return np.concatenate([off, small], axis=1) / sigma, np.array([n in measured for n in truth.names])


@pytest.mark.slow
def test_sigma0_memory_and_control(block: tuple[dict, Path, int, Published]) -> None:
    report, project, peak, _ = block
    (group,) = [g for g in report["groups"] if g["name"].startswith("image points")]
    sigma0 = 0.25 * group["found_to_stated"]
    points = read_image_points(project.parent / "image_points.csv")
    control = {"1003", "1005"}
    rows = [line.split(",") for line in (project.parent / "adjustment" / "image_points.csv").read_text().split("\n")]
    head = rows[0]
    at = [head.index(n) for n in ("point", "residual_x", "residual_y")]
    residuals = np.array([[float(r[at[1]]), float(r[at[2]])] for r in rows[1:] if len(r) > 1 and r[at[0]] in control])
    rms = np.sqrt((residuals**2).mean(axis=0))
    print(
        f"\nign_borea: {len(report['images'])} exposures, {len(points)} measurements, sigma0 {sigma0:.3f} px, "
        f"peak memory {peak / GIB:.2f} GiB, control residuals rms {rms.round(3)} px, largest "
        f"{np.abs(residuals).max():.2f} px, {len(report['gross_errors'])} gross errors"
    )
    assert len(report["images"]) == 805
    assert sigma0 <= 0.25
    assert peak <= 1.5 * GIB
    assert len(residuals) >= 15
    assert (rms <= 0.75).all()


@pytest.mark.slow
def test_orientations_lie_within_three_sigma_of_the_published_ones(block: tuple[dict, Path, int, Published]) -> None:
    """As many as normally distributed errors allow: 0.27 % lie beyond three standard deviations."""
    report, project, _, truth = block
    normalised, measured = deviations(project, truth)
    share, own = ((np.abs(n) <= 3.0).mean() for n in (normalised, normalised[measured]))
    spread = np.sqrt((normalised[measured] ** 2).mean(axis=0))
    (correlation,) = report["image_correlations"]
    print(
        f"\nign_borea: {share:.2%} of all {normalised.size} orientation parameters within 3 sigma of the published, "
        f"of the {measured.sum()} exposures with points {own:.2%}, spread {spread.round(2)}, largest "
        f"{np.abs(normalised[measured]).max():.2f}; {correlation['effect']:.1f} measurements count as one, errors "
        f"alike over {correlation['reach_px']:.0f} px"
    )
    assert share >= 0.995
    assert own >= 0.99
    assert np.abs(normalised[measured]).max() < 4.0
    assert (spread > 0.5).all() and (spread < 1.45).all()
