"""What may be behind observations that do not fit: other models of the same block, weighed against each other."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from photoplan.adjustment.chances import chance_gain
from photoplan.errors import PhotoplanError
from photoplan.orientation.bundle.adjust import adjust_block
from photoplan.orientation.bundle.alike import likeness_of
from photoplan.orientation.bundle.block import Adjusted, AdjustSettings, Block

#: Plain least squares of all that is not a gross error of an image point: nothing is thrown out, nothing reweighted.
_PLAIN = AdjustSettings(robust=False, variance_components=False, correlation=False, covariance=False)
#: Chance and part of the sum of squares from which a cause is named.
_CHANCE, _EXPLAINS = 1e-6, 0.3
#: Part of the sum of squares that a cause with more unknowns must explain beyond one with less.
_MORE = 0.1
#: Ratio of found to stated accuracy from which one asks for causes, and redundancy that the ratio needs.
_RATIO, _SOUND = 1.4, 15.0


@dataclass(frozen=True)
class Cause:
    """A model in which the observations fit better."""

    name: str
    """As users call it."""
    explains: float
    """Part of what does not fit that it takes away, 0 to 1."""
    change: float
    """By how much a camera constant changes, as a part of it; 0 for other causes."""
    remedy: str
    """What would regard it."""
    measure: str = "squared residuals"
    """What it takes away a part of; accuracies are weighed by the deviance, −2 times the logarithm of likelihood."""


def doubtful(result: Adjusted) -> bool:
    """Whether control or positions were thrown out, or accuracies are far from what was stated."""
    rejected = result.ground_rejected.any() or result.position_rejected.any()
    ratios = [g.factor for g in result.groups if g.redundancy > _SOUND and np.isfinite(g.factor)]
    return bool(rejected or any(ratio > _RATIO for ratio in ratios))


def weighed_causes(block: Block, result: Adjusted) -> tuple[Cause, ...]:
    """Causes that explain a good part of what does not fit, the likeliest first; empty where all is as stated.

    Each is an adjustment of the block with other unknowns, all control and positions included. It is named where
    unknowns without meaning would hardly lower the sum of squares as much (F-test). What the best of them leaves is
    weighed as errors of image points that are alike, and as other accuracies than stated, by their likelihood.
    """
    if not doubtful(result):
        return ()
    poses = dict(zip(result.images, result.poses))
    used = np.isfinite(result.residuals[:, 0]) & ~result.rejected
    start = replace(
        block,
        images=tuple(replace(image, pose=poses[image.name]) for image in block.images if image.name in poses),
        observations=block.observations.where(used),
    )
    try:
        base = adjust_block(start, _PLAIN)
    except PhotoplanError:
        return ()
    whole = base.sigma0**2 * base.redundancy
    found: list[tuple[Cause, int, Block, Adjusted]] = []
    for name, remedy, other in _models(start):
        try:
            tried = adjust_block(other, _PLAIN)
        except PhotoplanError:
            continue
        rest, more = tried.sigma0**2 * tried.redundancy, tried.unknowns - base.unknowns
        if more <= 0 or tried.redundancy <= 0 or not rest < whole:
            continue
        if chance_gain(whole, rest, more, tried.redundancy) < _CHANCE and (whole - rest) / whole > _EXPLAINS:
            changes = [a.c / block.cameras[a.name].c - 1 for a in tried.cameras if "c" in a.free]
            change = max(changes, key=abs, default=0.0) if "constant" in name else 0.0
            found.append((Cause(name, (whole - rest) / whole, change, remedy), more, other, tried))
    # A simpler cause that explains nearly as much is the likelier one.
    best = max((cause.explains for cause, *_ in found), default=0.0)
    found.sort(key=lambda item: (item[0].explains < best - _MORE * (1 - best) - 0.02, item[1], -item[0].explains))
    other, tried = found[0][2:] if found else (start, base)
    return (*(cause for cause, *_ in found), *_of_errors(other, tried, result))


def _of_errors(block: Block, base: Adjusted, result: Adjusted) -> tuple[Cause, ...]:
    """Other errors than stated: of image points that are alike, or larger ones of what else was observed.

    Control that does not agree with the rest is wrong by itself, and has no part in this.
    """
    XYZ = np.where(result.ground_rejected, np.nan, block.ground.XYZ)
    likeness = likeness_of(replace(block, ground=replace(block.ground, XYZ=XYZ)), base)
    if likeness is None:
        return ()
    found = []
    if likeness.alike:
        name = (
            f"errors of image points that are alike over about {float(f'{likeness.reach:.2g}'):.0f} px "
            f"({likeness.share:.0%} of their variance)"
        )
        remedy = (
            "look at the lens, the film and how points were measured; with many more points in each image the "
            "adjustment regards it"
        )
        found.append(Cause(name=name, explains=likeness.by_likeness, change=0.0, remedy=remedy, measure="deviance"))
    if likeness.worse:
        groups = ", ".join(f"{name} ({times:.1f} times)" for name, times in likeness.worse)
        name = f"errors that are larger than stated: {groups}"
        found.append(
            Cause(
                name=name,
                explains=likeness.by_accuracy,
                change=0.0,
                remedy="state their accuracy as it is",
                measure="deviance",
            )
        )
    return tuple(sorted(found, key=lambda cause: -cause.explains))


def _models(block: Block) -> Iterator[tuple[str, str, Block]]:
    """Other models of a block: name, remedy, block."""
    for name, camera in block.cameras.items():
        for what, parameters in (("camera constant", ("c",)), ("principal point", ("x0", "y0"))):
            if not set(parameters) <= set(camera.free):
                free = tuple(dict.fromkeys((*camera.free, *parameters)))
                cameras = {**block.cameras, name: replace(camera, free=free)}
                remedy = f"calibrate {', '.join(parameters)} of camera {name!r}, or state what is right"
                yield f"the {what} of camera {name!r}", remedy, replace(block, cameras=cameras)
    positions = block.positions
    if positions is None or block.drift == "linear":
        return
    if block.drift == "none":
        together = replace(positions, strip=("all",) * len(positions.images))
        remedy = "check datum, heights and antenna of the observed positions"
        yield (
            "a common shift of the observed positions (datum)",
            remedy,
            replace(block, positions=together, drift="shift"),
        )
        yield (
            "a shift of the observed positions in each strip",
            'drift = "shift" in [adjustment]',
            replace(block, drift="shift"),
        )
    yield (
        "a drift of the observed positions in each strip",
        'drift = "linear" in [adjustment]',
        replace(block, drift="linear"),
    )
