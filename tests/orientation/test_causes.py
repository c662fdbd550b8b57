"""What is behind observations that do not fit: the likeliest cause is named, and how much it explains."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tools.plain_block import FOCAL, Make, plain_block

from photoplan.orientation.bundle.adjust import adjust_block
from photoplan.orientation.bundle.block import Block
from photoplan.orientation.bundle.causes import weighed_causes


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
        ("constant", "the camera constant of camera 'cam'"),
        ("principal point", "the principal point of camera 'cam'"),
        ("datum", "a common shift of the observed positions"),
        ("shift", "a shift of the observed positions in each strip"),
        ("drift", "a drift of the observed positions in each strip"),
    ],
)
@pytest.mark.parametrize("seed", [2, pytest.param(1, marks=pytest.mark.slow)])
def test_the_cause_is_named(kind: str, words: str, seed: int) -> None:
    block = spoilt(kind, seed)
    result = adjust_block(block)
    found = weighed_causes(block, result)
    print([(c.name, round(c.explains, 3), round(c.change, 3)) for c in found], result.ground_rejected.sum())
    assert found and found[0].name.startswith(words)
    assert found[0].explains > 0.7
    if kind == "constant":
        assert found[0].change == pytest.approx(-0.5, abs=0.02)


def test_where_all_is_as_stated_or_a_point_is_wrong_nothing_is_blamed() -> None:
    truth = plain_block(Make(seed=3, gnss=0.05))
    assert weighed_causes(truth.block, adjust_block(truth.block)) == ()
    XYZ = truth.block.ground.XYZ.copy()
    XYZ[2] += (0.0, 3.0, -4.0)
    block = truth.with_ground(XYZ)
    result = adjust_block(block)
    assert result.ground_rejected.any()
    assert weighed_causes(block, result) == ()
