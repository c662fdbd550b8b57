"""Bundle adjustment: derivatives, least squares against a dense twin, calibrated covariances, gross errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tools.sim_block import FOCAL, Simulated, simulate
from tools.thinned import some, thinned

from photoplan.cameras.fiducials import Bilinear2D
from photoplan.cameras.lenses import Brown, OpenCV
from photoplan.geometry.pose import rotation_vector
from photoplan.orientation.bundle.adjust import adjust_block
from photoplan.orientation.bundle.equations import linearise, residuals_of, whitened
from photoplan.orientation.bundle.model import (
    PARAMETERS,
    Active,
    Adjusted,
    AdjustSettings,
    BlockCamera,
    build_model,
    start_state,
)
from photoplan.orientation.bundle.robust import select, start_points, weights_of

FILM = ("c", "x0", "y0")
PLAIN = AdjustSettings(robust=False, variance_components=False)


def prepared(simulated: Simulated):
    block = simulated.block
    selection = select(block, Active.all_of(block))
    XYZ, parallel = start_points(block, selection)
    assert not parallel
    model = build_model(block, selection.images, selection.measured, selection.points)
    poses = [block.images[k].pose for k in selection.images]
    return model, start_state(block, model.camera_names, model.strip_names, poses, XYZ)


def errors_of(simulated: Simulated, result: Adjusted) -> np.ndarray:
    """Errors of the orientations, (n, 6), in the parameters of their covariances."""
    true = [simulated.poses[int(name[1:])] for name in result.images]
    centers = np.array([p.center - t.center for p, t in zip(result.poses, true)])
    turns = np.array([t.R_ground_camera.T @ p.R_ground_camera for p, t in zip(result.poses, true)])
    return np.concatenate([centers, rotation_vector(turns)], axis=1)


@pytest.mark.parametrize("lens", [Brown(0.02, -0.01, 0.003, 1e-3, -5e-4, 1e-3, 5e-4), OpenCV(0.03, -0.02, 1e-3, -6e-4)])
def test_derivatives_are_those_of_the_residuals(lens: Brown | OpenCV) -> None:
    free = PARAMETERS if isinstance(lens, Brown) else PARAMETERS[:8]
    block = simulate(3, strips=2, images=3, gnss=0.1, attitude=1e-3, free=free, lens=lens).block
    block = replace(block, drift="linear", lever_arm=(0.3, -0.2, 1.0), lever_arm_sigma=0.1, boresight=True)
    model, state = prepared(Simulated(block, (), {}, FOCAL, np.zeros(0)))
    weight = weights_of(model, Active.all_of(block))
    rows, _ = linearise(model, state, np.sqrt(weight))
    rng = np.random.default_rng(0)
    count = model.columns.count
    # Each unknown moves the rows by about as much as a standard deviation or less.
    size = 1.0 / np.maximum(np.sqrt(np.asarray(rows.A_global.multiply(rows.A_global).sum(axis=0)).ravel()), 1e-12)
    dx, dX = rng.normal(size=count) * size * 1e-3, rng.normal(0, 1e-5, state.XYZ.shape)

    def at(factor: float) -> np.ndarray:
        return whitened(model, residuals_of(model, state.moved(model.columns, factor * dx, factor * dX)))

    numeric = (at(1.0) - at(-1.0)) / 2.0
    analytic = rows.A_global @ dx + rows.A_points @ dX.ravel()
    np.testing.assert_allclose(analytic, numeric, atol=3e-6 * np.abs(numeric).max())


def test_sparse_solution_equals_dense_least_squares() -> None:
    """Unknowns, covariances and redundancy numbers against the whole normal matrix, inverted."""
    simulated = simulate(5, strips=2, images=3, per_image=25, gnss=0.1, attitude=1e-3, free=("c", "k1"), cross=True)
    result = adjust_block(simulated.block, PLAIN)
    block = replace(
        simulated.block,
        images=tuple(replace(b, pose=p) for b, p in zip(simulated.block.images, result.poses)),
        cameras={"cam": replace(simulated.block.cameras["cam"], c=result.cameras[0].c, lens=result.cameras[0].lens)},
        start_points=dict(zip(result.points, result.XYZ)),
    )
    model, state = prepared(replace(simulated, block=block))
    state = replace(state, XYZ=result.XYZ)
    rows, _ = linearise(model, state, np.sqrt(weights_of(model, Active.all_of(block))))
    A = np.hstack([rows.A_global.toarray(), rows.A_points.toarray()])
    np.testing.assert_allclose(A.T @ rows.e, 0.0, atol=1e-3 * np.abs(A.T).sum(axis=1).max())
    Q = np.linalg.inv(A.T @ A)
    scale = result.sigma0**2
    for k in range(len(result.images)):
        np.testing.assert_allclose(
            result.pose_covariance[k], Q[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] * scale, rtol=1e-4
        )
    n = model.columns.count
    camera = model.columns.get("camera cam").part
    np.testing.assert_allclose(result.cameras[0].covariance, Q[camera, camera] * scale, rtol=1e-4)
    for k, both in enumerate(result.pose_camera_covariance):
        wanted = Q[6 * k : 6 * k + 6, camera] * scale
        np.testing.assert_allclose(both, wanted, rtol=1e-3, atol=1e-6 * np.abs(wanted).max())
    for p in (0, 7, 20):
        at = slice(n + 3 * p, n + 3 * p + 3)
        np.testing.assert_allclose(result.point_covariance[p], Q[at, at] * scale, rtol=1e-4)
    redundancy = 1.0 - np.einsum("ij,jk,ik->i", A, Q, A)
    np.testing.assert_allclose(
        result.redundancies[model.observation].ravel(), redundancy[: 2 * len(model.image)], atol=1e-6
    )
    np.testing.assert_allclose(redundancy.sum(), result.redundancy, atol=1e-5)


@thinned("count", 15, 200)
def test_simulated_blocks_are_unbiased_and_covariances_calibrated(count: int) -> None:
    """Normalised errors of orientations, camera and points have mean 0 and spread 0.9 to 1.1."""
    normal: dict[str, list[np.ndarray]] = {"orientations": [], "camera": [], "points": []}
    sigma0 = []
    for seed in range(count):
        simulated = simulate(
            seed, strips=2, images=4, per_image=24, gnss=0.05, free=("c", "x0", "y0"), cross=True, sigma=0.4
        )
        result = adjust_block(simulated.block, AdjustSettings(variance_components=False))
        sigma = np.sqrt(np.diagonal(result.pose_covariance, axis1=1, axis2=2))
        normal["orientations"].append(errors_of(simulated, result) / sigma)
        camera = result.cameras[0]
        off = np.array([camera.c - FOCAL, *camera.principal_point])
        normal["camera"].append((off / np.sqrt(np.diag(camera.covariance)))[None])
        true = np.array([simulated.points[n] for n in result.points])
        sigma = np.sqrt(np.diagonal(result.point_covariance, axis1=1, axis2=2))
        normal["points"].append((result.XYZ - true) / sigma)
        sigma0.append(result.sigma0)
    print(f"\n{count} simulated blocks: sigma0 {np.mean(sigma0):.3f}")
    for name, parts in normal.items():
        values = np.concatenate(parts)
        spread, mean = values.std(axis=0), values.mean(axis=0)
        print(f"  {name}: spread {spread.round(3)}, mean {mean.round(3)} of {len(values)}")
        # Errors within a block are correlated, so means are judged by the number of blocks.
        assert (np.abs(mean) < 4.0 / np.sqrt(count)).all()
        assert 0.9 <= float(np.sqrt((values**2).mean())) <= 1.1
        assert (spread > 0.85).all() and (spread < 1.15).all()
    assert 0.97 < np.mean(sigma0) < 1.03


@pytest.mark.parametrize("seed", some(range(5), 0))
def test_fault_17_a_tenth_of_gross_errors_is_found(seed: int) -> None:
    """Errors of 20 standard deviations to 200 pixels in a tenth of all image points."""
    simulated = simulate(seed, strips=3, images=6, per_image=70, gross=0.1)
    result = adjust_block(simulated.block)
    seen = simulated.block.observations
    good = np.bincount(seen.point, ~simulated.gross, len(seen.points))[seen.point]
    # Of two good rays and a wrong one along their strip nobody can say which is wrong; with three good ones one can.
    located = simulated.gross & (good >= 3)
    found = (result.rejected & located).sum() / located.sum()
    harmless = (np.isnan(result.residuals[:, 0]) | result.rejected)[simulated.gross].mean()
    clean = ~np.isin(seen.point, seen.point[simulated.gross])
    wrong = result.rejected[clean].mean()
    print(
        f"\nseed {seed}: {found:.1%} of {located.sum()} gross errors at points with three good rays found, "
        f"{harmless:.1%} of all {simulated.gross.sum()} take no part; {wrong:.2%} taken out at points without; "
        f"sigma0 {result.sigma0:.3f}"
    )
    assert found >= 0.99
    assert harmless >= 0.95
    assert wrong < 0.005
    assert 0.9 < result.sigma0 < 1.1
    sigma = np.sqrt(np.diagonal(result.pose_covariance, axis1=1, axis2=2))
    assert np.sqrt(((errors_of(simulated, result) / sigma) ** 2).mean()) < 2.0


def test_gross_errors_in_control_and_positions_are_found() -> None:
    simulated = simulate(2, strips=3, images=6, per_image=80, gnss=0.05, attitude=2e-4, base=0.2)
    block = simulated.block
    XYZ, seen = block.ground.XYZ.copy(), block.positions.XYZ.copy()
    rays = np.bincount(block.observations.point)
    wrong = int(np.argmax([rays[block.observations.points.index(n)] for n in block.ground.names]))
    XYZ[wrong, 2] += 5.0
    seen[7] += (0.0, 3.0, 0.0)
    block = replace(block, ground=replace(block.ground, XYZ=XYZ), positions=replace(block.positions, XYZ=seen))
    result = adjust_block(block)
    assert np.argwhere(result.ground_rejected).tolist() == [[wrong, 2]]
    assert np.flatnonzero(result.position_rejected).tolist() == [7]
    assert result.ground_residuals[wrong, 2] == pytest.approx(-5.0, abs=0.5)


@pytest.mark.parametrize("seed", some([6, 9], 0))
def test_a_block_that_only_control_holds_is_not_tilted_to_fit_wrong_control(seed: int) -> None:
    """Two corners wrong by a tilt's worth: six more heights of seven would go to keep them."""
    simulated = simulate(seed, strips=2, images=5, per_image=40, gross=0.03, control=9, height=300, relief=30, base=0.3)
    XYZ = simulated.block.ground.XYZ.copy()
    XYZ[0] += (-2.0, -1.5, 2.5)
    XYZ[2] += (2.0, -1.5, -2.5)
    result = adjust_block(replace(simulated.block, ground=replace(simulated.block.ground, XYZ=XYZ)))
    assert np.argwhere(result.ground_rejected).tolist() == [[0, 0], [0, 1], [0, 2], [2, 0], [2, 1], [2, 2]]
    sigma = np.sqrt(np.diagonal(result.pose_covariance, axis1=1, axis2=2))
    assert np.sqrt(np.mean((errors_of(simulated, result) / sigma) ** 2)) < 1.5


@pytest.mark.parametrize("seed", [3, 4])
def test_points_of_two_rays_are_no_gross_errors_because_half_of_their_residuals_are_none(seed: int) -> None:
    simulated = simulate(seed, strips=1, images=2, per_image=150, gnss=0.05, attitude=2e-4, tilt=0.01)
    result = adjust_block(simulated.block)
    assert int(result.rejected.sum()) <= 2
    images = next(group for group in result.groups if group.name.startswith("image points"))
    assert 0.85 < images.factor < 1.15


def test_check_points_do_not_take_part() -> None:
    simulated = simulate(2, strips=3, images=6)
    check = np.zeros(9, bool)
    check[4] = True
    XYZ = simulated.block.ground.XYZ.copy()
    XYZ[4] += 10.0
    block = replace(simulated.block, ground=replace(simulated.block.ground, check=check, XYZ=XYZ))
    result = adjust_block(block)
    assert not result.rejected.any() or result.rejected.mean() < 0.01
    np.testing.assert_allclose(result.ground_residuals[4], -10.0, atol=0.7)
    assert np.isnan(result.ground_normalised[4]).all()


def with_smooth_errors(simulated: Simulated, seed: int, size: float, reach: float) -> Simulated:
    """The block with further image errors that are smooth over `reach` pixels, each image's its own."""
    rng = np.random.default_rng(seed)
    seen = simulated.block.observations
    xy = seen.xy.copy()
    for k in range(len(seen.images)):
        mine = seen.image == k
        for axis in range(2):
            waves, phases = rng.normal(0, 1 / reach, (200, 2)), rng.uniform(0, 2 * np.pi, 200)
            xy[mine, axis] += size * np.sqrt(2 / 200) * np.cos(seen.xy[mine] @ waves.T + phases).sum(axis=1)
    return replace(simulated, block=replace(simulated.block, observations=replace(seen, xy=xy)))


@pytest.mark.slow
@pytest.mark.parametrize("count", [8])
def test_correlated_image_errors_are_noticed_and_covariances_stay_calibrated(count: int) -> None:
    """Errors that are alike over 500 of 4000 pixels: taken as independent, accuracies are twice too good."""
    spreads = {}
    for regarded in (True, False):
        normal, effects = [], []
        for seed in range(count):
            simulated = simulate(
                seed, strips=3, images=5, per_image=150, gnss=0.1, attitude=3e-4, sigma=0.2, base=0.25, control=9
            )
            simulated = with_smooth_errors(simulated, seed, 0.4, 500.0)
            result = adjust_block(simulated.block, AdjustSettings(correlation=regarded))
            sigma = np.sqrt(np.diagonal(result.pose_covariance, axis1=1, axis2=2))
            normal.append(errors_of(simulated, result) / sigma)
            effects += [c.effect for c in result.correlations]
        spreads[regarded] = float(np.sqrt((np.concatenate(normal) ** 2).mean()))
        print(f"\nregarded {regarded}: spread {spreads[regarded]:.2f}, effects {np.round(effects, 1)}")
    assert 0.8 <= spreads[True] <= 1.2
    assert spreads[False] > 1.6


def test_film_and_digital_images_are_adjusted_together() -> None:
    """Every second image as a film scan: its own camera in millimetres, turned and sheared, bilinear in the scan."""
    simulated = simulate(8, strips=3, images=6, per_image=60, cross=True)
    block = simulated.block
    seen = block.observations
    pitch = 0.02
    scans = {
        b.name: Bilinear2D(50.0 + k, 0.4, 1e-5, 2100.0 + 7 * k, 0.3, -49.8, -2e-5, 1600.0)
        for k, b in enumerate(block.images)
        if k % 2
    }
    xy = seen.xy.copy()
    for name, scan in scans.items():
        mine = seen.image == seen.images.index(name)
        digital = block.images[int(name[1:])].plane_to_pixel
        xy[mine] = scan(digital.inverse(seen.xy[mine]) * pitch)
    images = tuple(
        replace(b, camera="film", plane_to_pixel=scans[b.name]) if b.name in scans else b for b in block.images
    )
    cameras = {"cam": block.cameras["cam"], "film": BlockCamera(FOCAL * pitch * 1.001, (0.05, -0.03), Brown(), FILM)}
    mixed = replace(block, images=images, cameras=cameras, observations=replace(seen, xy=xy))
    result = adjust_block(mixed, AdjustSettings(variance_components=False))
    sigma = np.sqrt(np.diagonal(result.pose_covariance, axis1=1, axis2=2))
    assert np.sqrt(((errors_of(simulated, result) / sigma) ** 2).mean()) < 1.5
    (film,) = [c for c in result.cameras if c.name == "film"]
    off = np.array([film.c - FOCAL * pitch, *film.principal_point])
    assert (np.abs(off) < 4 * np.sqrt(np.diag(film.covariance))).all()
    assert np.sqrt(film.covariance[0, 0]) < 0.1
    assert len([g for g in result.groups if g.name.startswith("image points")]) == 2


def test_points_behind_the_cameras_do_not_stop_the_adjustment() -> None:
    """Wild measurements whose rays meet above the block, or nowhere, are taken out and named."""
    simulated = simulate(3, strips=2, images=5, per_image=60)
    seen = simulated.block.observations
    rng = np.random.default_rng(0)
    wild = np.flatnonzero(np.isin(seen.point, rng.choice(len(seen.points), 12, replace=False)))
    xy = seen.xy.copy()
    xy[wild] = rng.uniform(0, 2900, (len(wild), 2))
    result = adjust_block(replace(simulated.block, observations=replace(seen, xy=xy)))
    taken = result.rejected | np.isnan(result.residuals[:, 0])
    assert taken[wild].mean() > 0.9
    assert 0.9 < result.sigma0 < 1.1
    assert np.isfinite(result.XYZ).all() and np.isfinite(result.point_covariance).all()


def test_lever_arm_drift_and_boresight_are_recovered() -> None:
    simulated = simulate(4, strips=4, images=8, per_image=40, gnss=0.03, attitude=2e-4, cross=True, control=16)
    block = simulated.block
    lever, turn = np.array([0.4, -0.3, 1.2]), np.array([0.004, -0.002, 0.006])
    from photoplan.geometry.pose import small_rotations

    R = np.array([p.R_ground_camera for p in simulated.poses])
    strips = np.array([int(s[1:]) for s in block.positions.strip])
    epoch = np.array([block.positions.time[strips == s].mean() for s in range(4)])
    shift = np.random.default_rng(1).normal(0, 0.5, (4, 3))
    rate = np.random.default_rng(2).normal(0, 0.05, (4, 3))
    tau = (block.positions.time - epoch[strips])[:, None]
    moved = block.positions.XYZ + R @ lever + shift[strips] + rate[strips] * tau
    observed = block.attitudes.R_ground_camera @ small_rotations(turn[None])[0]
    block = replace(
        block,
        positions=replace(block.positions, XYZ=moved),
        attitudes=replace(block.attitudes, R_ground_camera=observed),
        drift="linear",
        lever_arm=(0.0, 0.0, 1.0),
        lever_arm_sigma=0.5,
        boresight=True,
    )
    result = adjust_block(block)
    assert (np.abs(result.boresight - turn) < 4 * result.boresight_sigma + 1e-5).all()
    assert (result.boresight_sigma < 2e-4).all()
    assert (np.abs(result.lever_arm - lever) < 4 * result.lever_arm_sigma).all()
    for k, strip in enumerate(result.strips):
        assert (np.abs(np.concatenate([strip.shift - shift[k], strip.rate - rate[k]])) < 4.5 * strip.sigma).all()
        assert (strip.sigma[3:] < 0.05).all()


def test_variance_components_find_the_accuracies() -> None:
    """Image points stated three times too good, positions four times too bad."""
    simulated = simulate(6, strips=4, images=8, per_image=60, gnss=0.5, sigma=0.6, control=25, control_sigma=0.02)
    block = simulated.block
    sigma = np.full_like(block.observations.sigma, 0.2)
    block = replace(
        block,
        observations=replace(block.observations, sigma=sigma),
        positions=replace(block.positions, sigma=np.full_like(block.positions.sigma, 2.0)),
    )
    result = adjust_block(block)
    factors = {g.name: g.factor for g in result.groups}
    print({k: round(v, 2) for k, v in factors.items()})
    assert factors["image points, camera cam"] == pytest.approx(3.0, rel=0.05)
    assert factors["observed positions, horizontal"] == pytest.approx(0.25, rel=0.3)
    assert result.sigma0 == pytest.approx(1.0, abs=0.05)


def test_opencv_lens_is_calibrated() -> None:
    """A block seen through OpenCV's lens gives its coefficients back, in OpenCV's own meaning."""
    true = OpenCV(-0.05, 0.02, 8e-4, -5e-4)
    simulated = simulate(7, strips=3, images=5, per_image=80, lens=true, sigma=0.2, cross=True, free=PARAMETERS[:8])
    start = replace(simulated.block.cameras["cam"], lens=OpenCV())
    block = replace(simulated.block, cameras={"cam": start})
    result = adjust_block(block)
    camera = result.cameras[0]
    assert isinstance(camera.lens, OpenCV)
    sigma = np.sqrt(np.diag(camera.covariance))
    off = np.array(
        [camera.lens.k1 - true.k1, camera.lens.k2 - true.k2, camera.lens.p2 - true.p2, camera.lens.p1 - true.p1]
    )
    at = [camera.free.index(n) for n in ("k1", "k2", "p1", "p2")]
    assert (np.abs(off) < 4 * sigma[at]).all()
    assert sigma[camera.free.index("p1")] < 2e-4
