"""What is behind observations that do not fit: the likeliest cause is named, and how much it explains."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tools.plain_block import FOCAL, Make, Truth, plain_block

from photoplan.adjustment.statistics import variance_components
from photoplan.errors import GeometryError
from photoplan.orientation.bundle.adjust import adjust_block, misfit_hypotheses
from photoplan.orientation.bundle.model import Block


def spoilt(kind: str, seed: int) -> Block:
    # A constant of twice the right value asks for more than a small block can say.
    images, points = (5, 110) if kind == "constant" else (4, 70)
    truth = plain_block(Make(seed, 3, images, gnss=0.05, relief=30.0, height=150.0, control=12, points=points))
    block, rng = truth.block, np.random.default_rng(seed)
    positions = block.positions
    assert positions is not None
    strip = np.array([int(s[1:]) for s in positions.strip])
    if kind == "constant":
        return replace(block, cameras={"cam": replace(block.cameras["cam"], c=2 * FOCAL)})
    if kind == "principal point":
        return replace(block, cameras={"cam": replace(block.cameras["cam"], principal_point=(40.0, -30.0))})
    if kind == "datum":
        shift = np.broadcast_to([0.8, -0.5, 1.1], positions.XYZ.shape)
    elif kind == "shift":
        shift = rng.normal(0, 0.8, (strip.max() + 1, 3))[strip]
    else:
        along = positions.time - np.array([positions.time[strip == s].mean() for s in strip])
        shift = rng.normal(0, 0.5, (strip.max() + 1, 3))[strip] * along[:, None]
    return replace(block, positions=replace(positions, XYZ=positions.XYZ + shift))


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        pytest.param("constant", "the camera constant of camera 'cam'", marks=pytest.mark.slow),
        pytest.param("principal point", "the principal point of camera 'cam'", marks=pytest.mark.slow),
        pytest.param("datum", "a common shift of the observed positions", marks=pytest.mark.slow),
        pytest.param("shift", "a shift of the observed positions in each strip", marks=pytest.mark.slow),
        ("drift", "a drift of the observed positions in each strip"),
    ],
)
@pytest.mark.parametrize("seed", [2, pytest.param(1, marks=pytest.mark.slow)])
def test_the_cause_is_named(kind: str, words: str, seed: int) -> None:
    block = spoilt(kind, seed)
    result = adjust_block(block)
    found = misfit_hypotheses(block, result)
    print([(c.name, round(c.explains, 3), round(c.change, 3)) for c in found], result.ground_rejected.sum())
    assert found and found[0].name.startswith(words)
    assert found[0].explains > 0.7
    if kind == "constant":
        assert found[0].change == pytest.approx(-0.5, abs=0.02)


def test_where_all_is_as_stated_or_a_point_is_wrong_nothing_is_blamed() -> None:
    truth = plain_block(Make(3, 3, 5, gnss=0.05))
    assert misfit_hypotheses(truth.block, adjust_block(truth.block)) == ()
    XYZ = truth.block.ground.XYZ.copy()
    XYZ[2] += (0.0, 3.0, -4.0)
    block = truth.with_ground(XYZ)
    result = adjust_block(block)
    assert result.ground_rejected.any()
    assert misfit_hypotheses(block, result) == ()


def alike(truth: Truth, seed: int, size: float, reach: float) -> Block:
    """Errors of image points that are alike, covariance size² exp(−(d / reach)²), beside those of the block."""
    rng, seen = np.random.default_rng(1000 + seed), truth.block.observations
    xy = seen.xy.copy()
    for image in range(len(seen.images)):
        mine = seen.image == image
        distance = np.linalg.norm(seen.xy[mine][:, None] - seen.xy[mine], axis=2)
        covariance = size**2 * np.exp(-((distance / reach) ** 2)) + 1e-9 * np.eye(mine.sum())
        xy[mine] += np.linalg.cholesky(covariance) @ rng.normal(size=(mine.sum(), 2))
    return replace(truth.block, observations=replace(seen, xy=xy))


def poor_positions(truth: Truth, seed: int, sigma: float) -> Block:
    positions = truth.block.positions
    assert positions is not None
    off = np.random.default_rng(2000 + seed).normal(0, sigma, positions.XYZ.shape)
    return replace(truth.block, positions=replace(positions, XYZ=positions.XYZ + off))


def low_block(seed: int, points: int, images: int) -> Truth:
    """From 100 m, pixels of 2.8 cm, positions of 2 cm."""
    return plain_block(Make(seed, 4, images, 100.0, 5.0, points, sigma=0.2, gnss=0.02, control=10, control_sigma=0.01))


def told(block: Block) -> list[tuple[str, float]]:
    result = adjust_block(block)
    ratios = [round(group.factor, 1) for group in result.groups if "positions" in group.name]
    found = [(cause.name, cause.explains) for cause in misfit_hypotheses(block, result)]
    print(f"{len(block.observations) / len(block.images):.0f} points an image, positions {ratios}, {found}")
    return found


def test_image_errors_that_are_alike_are_told_from_poor_positions() -> None:
    """Errors alike over 400 of 4000 pixels, 16 points an image: residuals of so few points do not show it."""
    truth = low_block(2, 90, 5)
    (name, explains), *others = told(alike(truth, 2, 1.0, 400.0))
    assert name.startswith("errors of image points that are alike over about 4") and explains > 0.9 and not others
    (name, explains), *others = told(poor_positions(truth, 2, 0.06))
    assert name.startswith("errors that are larger than stated: observed positions")
    assert explains > 0.9 and not others


@pytest.mark.slow
def test_the_same_in_many_blocks_sparse_and_dense() -> None:
    right = {"alike": [0, 0], "positions": [0, 0]}
    for points in (60, 90, 130, 200, 500):
        for seed in range(6 if points < 200 else 3):
            truth = low_block(seed, points, 7)
            for what, block in (
                ("alike", alike(truth, seed, 1.0, 400.0)),
                ("positions", poor_positions(truth, seed, 0.06)),
            ):
                try:
                    found = told(block)
                except GeometryError:  # An image with too few points in so sparse a block.
                    continue
                words = "alike over" if what == "alike" else "larger than stated: observed positions"
                right[what][0] += bool(found) and words in found[0][0]
                right[what][1] += 1
                # The other one is never named.
                assert not any(("alike over" in name) != (what == "alike") for name, _ in found)
    print(right)
    for good, of in right.values():
        assert of >= 20 and good >= 0.9 * of


def test_likelihood_of_components_against_written_out_densities() -> None:
    """Two variances of a grouped mean (analysis of variance), where restricted likelihood has a closed form."""
    rng, groups, each = np.random.default_rng(0), 12, 5
    y = np.repeat(rng.normal(0, 2.0, groups), each) + rng.normal(0, 0.7, groups * each)
    Z = np.repeat(np.eye(groups), each, axis=0)
    K = np.linalg.svd(np.ones((1, len(y))))[2][1:].T
    found = variance_components(K.T @ y, np.zeros((len(y) - 1,) * 2), [K.T @ K, K.T @ Z @ Z.T @ K], [1.0, 1.0])
    means = y.reshape(groups, each).mean(axis=1)
    within = ((y.reshape(groups, each) - means[:, None]) ** 2).sum() / (groups * (each - 1))
    between = means.var(ddof=1) - within / each
    assert found.variances == pytest.approx([within, between], rel=1e-3)
    V = found.variances[0] * np.eye(len(y)) + found.variances[1] * Z @ Z.T
    from scipy.stats import multivariate_normal  # a second of each collection

    density = multivariate_normal(np.zeros(len(y) - 1), K.T @ V @ K).logpdf(K.T @ y)
    assert found.deviance == pytest.approx(-2 * density - (len(y) - 1) * np.log(2 * np.pi))
