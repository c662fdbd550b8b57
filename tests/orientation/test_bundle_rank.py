"""Fault 16: what the observations do not determine is named."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import sparse
from tools.sim_block import simulate

from photoplan.cameras.lenses import RadialTable
from photoplan.errors import GeometryError, UsageError
from photoplan.orientation.bundle.adjust import adjust_block
from photoplan.orientation.bundle.equations import check_rank


def test_fault_16_a_block_without_control_has_no_datum() -> None:
    block = simulate(1).block
    block = replace(block, ground=block.ground.where(np.zeros(9, bool)))
    with pytest.raises(GeometryError) as error:
        adjust_block(block)
    text = str(error.value)
    print(text)
    for part in ("7 directions", "position of the block in X", "rotation of the block about Z", "scale of the block"):
        assert part in text


def test_fault_16_two_control_points_leave_a_rotation() -> None:
    block = simulate(1).block
    block = replace(block, ground=block.ground.where([0, 1]))
    with pytest.raises(GeometryError, match="1 direction of the unknowns free"):
        adjust_block(block)


def test_fault_16_collinear_control_leaves_a_rotation() -> None:
    block = simulate(1).block
    line = block.ground.where([0, 3, 6])
    XYZ = line.XYZ.copy()
    XYZ[1] = (XYZ[0] + XYZ[2]) / 2
    with pytest.raises(GeometryError, match="1 direction of the unknowns free"):
        adjust_block(replace(block, ground=replace(line, XYZ=XYZ)))


def test_fault_16_free_camera_constant_over_flat_terrain() -> None:
    """Vertical images of one height over a plane: the camera constant and the flying height cannot be told apart."""
    simulated = simulate(1, relief=0.0, tilt=0.0, free=("c",))
    level = tuple(
        replace(b, pose=type(b.pose)(np.array([*p.center[:2], 1000.0]), p.R_ground_camera))
        for b, p in zip(simulated.block.images, simulated.poses)
    )
    with pytest.raises(GeometryError) as error:
        adjust_block(replace(simulated.block, images=level))
    print(error.value)
    assert "c of camera 'cam'" in str(error.value)
    assert "Z0 of image" in str(error.value)


def test_images_without_overlap_are_named() -> None:
    block = simulate(1).block
    image = np.array(block.observations.images)[block.observations.image]
    alone = block.observations.where(image != "I5")
    result = adjust_block(replace(block, observations=alone))
    assert "I5" not in result.images
    assert dict(result.left_out)["I5"] == "image with 0 points that can be used; 3 are needed"


def test_a_lens_without_such_coefficients_is_refused() -> None:
    block = simulate(1, free=("k1",)).block
    table = RadialTable((0.1, 0.5), (1e-5, 2e-5))
    camera = replace(block.cameras["cam"], lens=table)
    with pytest.raises(UsageError, match="k1 cannot be free with its lens"):
        adjust_block(replace(block, cameras={"cam": camera}))
    with pytest.raises(UsageError, match="'k9'; allowed are c, x0"):
        adjust_block(replace(block, cameras={"cam": replace(block.cameras["cam"], free=("k9",))}))


def test_equations_that_are_no_numbers_are_named_and_not_decomposed() -> None:
    """A single gross value may drive iterations so far that nothing is finite any more."""
    kind = SimpleNamespace(owners=("a", "b"), width=3, part=slice(0, 6))
    model: Any = SimpleNamespace(columns=SimpleNamespace(kinds=(kind,)))
    S = np.eye(6)
    S[4, 4] = np.nan
    reduced: Any = SimpleNamespace(S=sparse.csr_matrix(S))
    with pytest.raises(GeometryError, match="equations of 'b' are no numbers"):
        check_rank(model, model, reduced)
