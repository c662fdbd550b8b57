"""Strips and satellites in the bundle adjustment: derivatives, unbiased corrections with right accuracy, datum."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tools.sim_strip import ORIGIN, SimulatedStrips, lines, places, projection, satellites, seen_by, simulated
from tools.thinned import some, thinned

from photoplan.cameras.base import project
from photoplan.cameras.correctable import TrackPriors
from photoplan.cameras.frame import FrameCamera
from photoplan.cameras.lenses import Interior, NoLens
from photoplan.cameras.observed import ImagePoints
from photoplan.errors import GeometryError
from photoplan.geometry.pose import Pose, rotation_opk
from photoplan.orientation.bundle.adjust import adjust_block
from photoplan.orientation.bundle.equations import linearise, residuals_of, whitened
from photoplan.orientation.bundle.model import (
    Active,
    AdjustSettings,
    Block,
    BlockCamera,
    BlockImage,
    Model,
    State,
    build_model,
    start_state,
)
from photoplan.orientation.bundle.robust import select, start_points, weights_of

PLAIN = AdjustSettings(robust=False, variance_components=False, correlation=False)
EVERYTHING = TrackPriors(
    boresight=2e-3,
    lever_arm=0.1,
    time_offset=0.01,
    knots=10.0,
    position=0.05,
    attitude=5e-5,
    smooth_position=0.03,
    smooth_attitude=3e-5,
)


def strip(seed: int, priors: TrackPriors, points: int = 60, **how: object) -> SimulatedStrips:
    made = [projection(name, "lines", g, 250.0, 2250.0) for name, g in lines(priors).items()]
    return simulated(made, places(points, 1), seed, **how)  # type: ignore[arg-type]


def triplet(seed: int, form: str, control: int, sigma: tuple[float, float] = (10.0, 2.0)) -> SimulatedStrips:
    made = [projection(n, "rational polynomials", g, 300.0, 6e5) for n, g in satellites(form, sigma=sigma).items()]
    rng = np.random.default_rng(2)
    at = np.column_stack([rng.uniform(599e3, 606e3, 60), rng.uniform(5_336e3, 5_345e3, 60), rng.uniform(100, 600, 60)])
    return simulated(made, at, seed, control=control)


def prepared(block: Block) -> tuple[Model, State]:
    selection = select(block, Active.all_of(block))
    XYZ, _ = start_points(block, selection)
    model = build_model(block, selection.images, selection.measured, selection.points)
    return model, start_state(block, model.camera_names, model.strip_names, [], XYZ, model.sets)


@pytest.mark.parametrize("made", ["strip", "affine"])
def test_derivatives_of_corrections_are_those_of_the_residuals(made: str) -> None:
    block = (strip(1, EVERYTHING) if made == "strip" else triplet(1, "affine", 4)).block
    model, state = prepared(block)
    rng = np.random.default_rng(0)
    # Away from zero, where some derivatives would vanish that do not elsewhere.
    step = rng.normal(size=model.columns.count)
    rows, _ = linearise(model, state, np.sqrt(weights_of(model, Active.all_of(block))))
    size = 1.0 / np.sqrt(np.asarray(rows.A_global.multiply(rows.A_global).sum(axis=0)).ravel())
    state = state.moved(model.columns, 0.3 * size * step, np.zeros_like(state.XYZ))
    rows, _ = linearise(model, state, np.sqrt(weights_of(model, Active.all_of(block))))
    dx, dX = rng.normal(size=len(size)) * size * 0.01, rng.normal(0.0, 1e-3, state.XYZ.shape)

    def at(sign: float) -> np.ndarray:
        return whitened(model, residuals_of(model, state.moved(model.columns, sign * dx, sign * dX)))

    numeric = (at(1.0) - at(-1.0)) / 2
    analytic = rows.A_global @ dx + rows.A_points @ dX.ravel()
    assert np.abs(numeric).max() > 1e-3
    assert np.abs(numeric - analytic).max() < 1e-3 * np.abs(numeric).max()


def normalised(made: SimulatedStrips, settings: AdjustSettings = PLAIN) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Errors of corrections by set, and of points, in their standard deviations; residual redundancy taken as one."""
    found = adjust_block(made.block, settings)
    # Standard deviations hold sigma0; the truth has one.
    errors = {}
    for each in found.corrections:
        sigma = np.sqrt(np.diagonal(each.covariance, axis1=1, axis2=2)) / found.sigma0
        errors[each.key] = (each.values - made.true[each.key]) / sigma
    XYZ = np.array([made.XYZ[name] for name in found.points])
    sigma = np.sqrt(np.diagonal(found.point_covariance, axis1=1, axis2=2)) / found.sigma0
    return errors, (found.XYZ - XYZ) / sigma


@thinned("runs", 1, 200)
def test_boresight_clock_and_splines_are_unbiased_with_right_accuracy(runs: int) -> None:
    """Truth is drawn from what is known beforehand, so that normalised errors have a standard deviation of one."""
    mount, spline, points = [], [], []
    for seed in range(runs):
        errors, at = normalised(strip(seed, EVERYTHING))
        mount.append(errors["mount of 'camera'"][0])
        spline.append(errors["trajectory of 'flight'"].ravel())
        points.append(at.ravel())
    # Errors of one run are correlated: bounds are for the number of independent ones, about a run's unknowns.
    for z, wide in ((np.array(mount), 1.0), (np.array(spline), 0.5), (np.array(points), 0.4)):
        loose = wide * 2.6 / np.sqrt(runs)
        assert np.abs(z.mean(axis=0)).max() < 4.0 / np.sqrt(runs)
        assert 1.0 - max(loose, 0.1) < np.sqrt((z**2).mean()) < 1.0 + max(loose, 0.1)


@thinned("runs", 3, 100)
@pytest.mark.parametrize("form", some(["shift", "drift", "affine"], 0, 2))
def test_polynomials_are_corrected_with_right_accuracy(runs: int, form: str) -> None:
    z = [np.concatenate(list(normalised(triplet(seed, form, 4))[0].values())) for seed in range(runs)]
    assert np.abs(np.mean(z)) < 3.0 / np.sqrt(runs)
    assert 1.0 - max(0.1, 1.0 / np.sqrt(runs)) < np.sqrt(np.mean(np.square(z))) < 1.0 + max(0.1, 1.0 / np.sqrt(runs))


def test_fault_16_what_only_priors_place_is_named() -> None:
    found = adjust_block(triplet(3, "shift", 0).block, PLAIN)
    # The height changes what these polynomials do across the image, so that points say something of it.
    assert {f"position of the block in {axis}" for axis in "XY"} <= set(found.by_prior)
    assert adjust_block(triplet(3, "shift", 4).block, PLAIN).by_prior == ()


def test_fault_16_what_nothing_determines_is_named() -> None:
    unknown = TrackPriors(knots=30.0, position=np.inf, attitude=5e-5)
    nothing = {each.key: 0 * each.values for each in lines(unknown)["nadir"].corrections}
    made = strip(1, unknown, control=0, true=nothing)
    with pytest.raises(GeometryError, match="position of the block in Y"):
        adjust_block(made.block, PLAIN)


@pytest.mark.parametrize("made", [pytest.param("strip", marks=pytest.mark.slow), "shift"])
def test_fault_17_gross_errors_are_found_by_name(made: str) -> None:
    block = (strip(5, replace(EVERYTHING, knots=None), 40) if made == "strip" else triplet(5, "shift", 4)).block
    clean = adjust_block(block)
    assert not clean.rejected.any() and not clean.ground_rejected.any()
    points = block.observations
    xy = points.xy.copy()
    wrong = [20, 61, 90]
    xy[wrong] += [[8.0, 0.0], [0.0, -40.0], [300.0, 90.0]]
    found = adjust_block(replace(block, observations=replace(points, xy=xy)))
    # A point of two rays says that one is wrong, not which.
    lost = {points.points[k] for k in points.point[np.flatnonzero(found.rejected)]}
    assert lost == {points.points[k] for k in points.point[wrong]}
    for before, after in zip(clean.corrections, found.corrections):
        sigma = np.sqrt(np.diagonal(before.covariance, axis1=1, axis2=2))
        assert (np.abs(after.values - before.values) < sigma).all()


def test_frames_strips_and_satellites_stand_in_one_block() -> None:
    """Without control of its own a strip and a satellite lie where the frames are, and the frames gain by them."""
    rng = np.random.default_rng(7)
    at, sigma = places(60, 3), 0.2
    interior, lens = Interior.digital((6000, 4000), (5000.0, 5000.0)), NoLens()
    poses, rows, images = [], [], []
    for k, dx in enumerate((-1200.0, -400.0, 400.0, 1200.0)):
        angles = rng.normal(0.0, 0.02, 3)
        pose = Pose(np.array([ORIGIN[0] + 2100.0 + dx, ORIGIN[1] + 30.0 * k, 2300.0]), rotation_opk(*angles))
        camera = FrameCamera(interior, lens, pose)
        poses.append(pose)
        start = Pose(pose.center + rng.normal(0.0, 2.0, 3), rotation_opk(*(angles + rng.normal(0.0, 1e-3, 3))))
        images.append(BlockImage(f"I{k}", "c", interior.tangent_to_pixel, start))
        for n in np.flatnonzero(seen_by(camera, at)):
            rows.append((f"P{n}", f"I{k}", *(project(camera, at[n]) + rng.normal(0.0, sigma, 2)).tolist()))
    strips = [projection(n, "lines", g, 250.0, 2250.0) for n, g in lines(replace(EVERYTHING, knots=None)).items()]
    space = [projection(n, "polynomials", g, 250.0, 6e5) for n, g in satellites("shift", 1).items()]
    made = simulated([*strips, *space], at, 8, sigma)
    frames = ImagePoints.from_rows(rows, sigma)
    block = replace(
        made.block,
        cameras={"c": BlockCamera(1.0, (0.0, 0.0), lens)},
        images=tuple(images),
        observations=ImagePoints.merged([frames, made.block.observations]),
    )
    alone = adjust_block(replace(block, projections=(), observations=frames), PLAIN)
    both = adjust_block(block, PLAIN)
    assert both.projections == ("forward", "nadir", "backward", "sat0") and len(both.images) == 4
    off = np.array([found.center - poses[int(name[1:])].center for name, found in zip(both.images, both.poses)])
    sigmas = [np.sqrt(np.diagonal(a.pose_covariance[:, :3, :3], axis1=1, axis2=2)) / a.sigma0 for a in (alone, both)]
    assert (sigmas[1] < sigmas[0]).all()
    assert np.abs(off / sigmas[1]).max() < 4.0
    for each in both.corrections:
        spread = np.sqrt(np.diagonal(each.covariance, axis1=1, axis2=2)) / both.sigma0
        assert np.abs((each.values - made.true[each.key]) / spread).max() < 4.0
