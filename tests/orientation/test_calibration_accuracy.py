"""Stated accuracy of a calibrated camera in simulated blocks, flat and hilly, under errors that residuals hide."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from tools.sim_block import FOCAL, Simulated, simulate

from photoplan.orientation.bundle.adjust import adjust_block

FREE = ("c", "x0", "y0", "k1", "k2")
#: Blocks of 15 images with forward overlap of 75 %.
BLOCK = {"strips": 3, "images": 5, "base": 0.25, "sigma": 0.3}
Blocks = Callable[[int], Simulated]


def flat(gnss: float, per_image: int = 60, relief: float = 3.0) -> Blocks:
    """Blocks whose positions have independent errors."""
    return lambda seed: simulate(seed, relief=relief, gnss=gnss, per_image=per_image, **BLOCK)


def off_together(common: float, own: float) -> Blocks:
    """Positions that are all off by one error, and little each by itself; stated as what they are off by."""

    def made(seed: int) -> Simulated:
        simulated = flat(own)(seed)
        positions = simulated.block.positions
        assert positions is not None
        XYZ = positions.XYZ + np.random.default_rng(seed + 7).normal(size=3) * common
        sigma = np.full_like(positions.sigma, np.hypot(common, own))
        return replace(simulated, block=replace(simulated.block, positions=replace(positions, XYZ=XYZ, sigma=sigma)))

    return made


def with_unknown_part(low: float, high: float, part: float) -> Blocks:
    """Image points with stated standard deviations from `low` to `high`, and a further error that none states."""

    def made(seed: int) -> Simulated:
        simulated = simulate(seed, relief=3.0, gnss=0.05, per_image=90, **{**BLOCK, "sigma": 1e-6})
        rng, seen = np.random.default_rng(seed + 99), simulated.block.observations
        stated = np.exp(rng.uniform(np.log(low), np.log(high), len(seen)))[:, None]
        xy = seen.xy + rng.normal(size=seen.xy.shape) * np.sqrt(stated**2 + part**2)
        points = replace(seen, xy=xy, sigma=np.repeat(stated, 2, axis=1))
        return replace(simulated, block=replace(simulated.block, observations=points))

    return made


def normalised(blocks: Blocks, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Errors of the free parameters divided by their standard deviations, and these, each (count, 5)."""
    errors, sigmas = [], []
    for seed in range(count):
        block = blocks(seed).block
        found = adjust_block(replace(block, cameras={"cam": replace(block.cameras["cam"], free=FREE)})).cameras[0]
        values = [found.c - FOCAL, *found.principal_point, found.lens.k1, found.lens.k2]  # type: ignore[attr-defined]
        sigmas.append(np.sqrt(np.diag(found.covariance)))
        errors.append(values / sigmas[-1])
    return np.array(errors), np.array(sigmas)


#: Of c: 3.9 and 1.5 standard deviations in 50 runs, see docs/status.md.
MISSED = pytest.mark.xfail(strict=True, reason="normalised errors of c 3.9 and 1.5")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "blocks"),
    [
        ("flat, positions of 3 cm", flat(0.03)),
        ("flat, positions of 3 m", flat(3.0)),
        ("hilly, positions of 3 m", flat(3.0, relief=80.0)),
        pytest.param("flat, positions off together by 3 m", off_together(3.0, 0.3), marks=MISSED),
        pytest.param("flat, image points with an unknown part", with_unknown_part(0.01, 0.2, 0.2), marks=MISSED),
    ],
)
def test_stated_accuracy_of_a_calibrated_camera(name: str, blocks: Blocks) -> None:
    errors, sigmas = normalised(blocks, 50)
    size = np.sqrt((errors**2).mean(axis=0))
    print(f"\n{name}: normalised errors {dict(zip(FREE, size.round(2)))}, all {np.sqrt((errors**2).mean()):.2f}; ")
    print(f"  standard deviations (median) {dict(zip(FREE, np.median(sigmas, axis=0).round(5)))}")
    assert 0.8 <= np.sqrt((errors**2).mean()) <= 1.25
    # Of 50 runs the size itself has a standard deviation of a tenth.
    assert (size > 0.7).all() and (size < 1.35).all()


def test_positions_that_are_off_together_do_not_bend_the_camera_unseen() -> None:
    """Before, c was 28 of its standard deviations off: residuals show 0.3 m of the 3 m that are stated."""
    simulated = off_together(3.0, 0.3)(1)
    block = replace(simulated.block, cameras={"cam": replace(simulated.block.cameras["cam"], free=("c",))})
    result = adjust_block(block)
    c, sigma = result.cameras[0].c, float(np.sqrt(result.cameras[0].covariance[0, 0]))
    assert abs(c - FOCAL) > 5.0 and abs(c - FOCAL) < 3.0 * sigma
    assert result.common is not None and result.common[2] == pytest.approx(3.0, rel=0.05)


def test_standard_deviations_of_image_points_get_the_part_that_none_states() -> None:
    """Stated 0.01 to 0.2 px, true 0.2 px and more: the weights become nearly alike."""
    simulated = with_unknown_part(0.01, 0.2, 0.2)(3)
    result = adjust_block(simulated.block)
    good = np.isfinite(result.normalised[:, 0]) & ~result.rejected
    stated = simulated.block.observations.sigma[good, 0]
    squares = result.normalised[good] ** 2
    size = [float(np.nanmean(squares[part])) for part in (stated < 0.03, stated > 0.1)]
    assert all(0.7 < s < 1.3 for s in size)
    assert result.rejected.mean() < 0.01
