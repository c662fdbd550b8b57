"""A block in millimetres, metres or kilometres is one block; fixed control is fixed; what is not estimated says so."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tools.plain_block import Make, plain_block
from tools.thinned import some

from photoplan.geometry.pose import Pose
from photoplan.orientation.bundle.adjust import adjust_block
from photoplan.orientation.bundle.model import AdjustSettings, Block


def scaled(block: Block, unit: float) -> Block:
    """The block with all lengths in another unit."""
    assert block.positions is not None
    images = tuple(replace(b, pose=Pose(b.pose.center * unit, b.pose.R_ground_camera)) for b in block.images)
    ground = replace(block.ground, XYZ=block.ground.XYZ * unit, sigma=block.ground.sigma * unit)
    positions = replace(block.positions, XYZ=block.positions.XYZ * unit, sigma=block.positions.sigma * unit)
    return replace(block, images=images, ground=ground, positions=positions)


@pytest.mark.parametrize("sigma", some([0.03, 0.0], 0))
def test_image_residuals_know_no_unit_of_length(sigma: float) -> None:
    block = plain_block(Make(seed=4, gnss=0.05)).block
    block = replace(block, ground=replace(block.ground, sigma=np.full(block.ground.XYZ.shape, sigma)))
    settings = AdjustSettings(variance_components=False)
    results = {unit: adjust_block(scaled(block, unit), settings) for unit in (1.0, 1e3, 1e-3)}
    for unit, result in results.items():
        np.testing.assert_array_equal(result.ground_rejected, results[1.0].ground_rejected)
        np.testing.assert_allclose(result.residuals, results[1.0].residuals, rtol=0, atol=1e-9)
        np.testing.assert_allclose(result.XYZ / unit, results[1.0].XYZ, rtol=0, atol=1e-7)


def test_control_of_sigma_0_is_held() -> None:
    block = plain_block(Make(seed=4, gnss=0.05, control_sigma=1e-4)).block
    block = replace(block, ground=replace(block.ground, sigma=np.zeros(block.ground.XYZ.shape)))
    result = adjust_block(block)
    kept = ~result.ground_rejected & np.isfinite(result.ground_residuals)
    assert kept.sum() >= 24
    assert np.abs(result.ground_residuals[kept]).max() < 1e-8


def test_factors_that_were_not_estimated_are_none() -> None:
    block = plain_block(Make(seed=1, control=4)).block
    factors = {g.name: (g.factor, g.redundancy) for g in adjust_block(block).groups}
    assert np.isfinite(factors["image points, camera cam"][0])
    assert factors["control, height"][1] < 10 and np.isnan(factors["control, height"][0])
