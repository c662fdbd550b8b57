"""What the figures of a surface tell against it, and the command that mends it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from photoplan.products.surface.plan import HARDLY, SurfacePlan
from photoplan.products.surface.spread import median

#: An image whose sigma0 is so many times the median of the others is told of; or all, if sigma0 is this part of the
#: contrast of the surface. Parts of the heights that fit badly, last corrections, and standard deviations, pixels of
#: parallax, from which it is told; so many of them without a height.
_ALONE, _NOISY, _MISFITS, _MOVING, _VAGUE, _ASTRAY = 1.6, 0.35, 0.02, 0.2, 1.0, 0.001
#: Where this part of the heights fits badly, the median standard deviation tells that, and nothing of texture.
_MOST_MISFIT = 0.25
#: From this part of the reach on it tells that nothing was found there.
_LOST = 0.1
#: Residuals in parts of the noise of pixels by themselves, and of the mean grey value, from which on it is no noise.
_CONTENT, _NO_NOISE = 2.0, 0.08
#: Standard deviations by which noise alone may still move heights in the last iteration.
_NOISE_MOVES = 1.0


def findings(
    plan: SurfacePlan,
    sigma0: dict[str, float | None],
    contrast: float,
    sigma_px: float | None,
    misfit_share: float,
    correction: float,
    astray: float,
) -> tuple[str, ...]:
    """Lines about a surface that should not be trusted as it is; none if nothing speaks against it."""
    return (
        *filter(None, [plan.gap_text]),
        *_of_images(plan, sigma0, contrast),
        *_of_fits(plan, misfit_share, astray),
        *_of_moves(plan, correction, sigma_px),
        *_of_noise(plan, sigma_px, misfit_share),
    )


def contradicted(plan: SurfacePlan, totals: Mapping[str, Any]) -> str:
    """Sentence that says why the images contradict a surface; empty if they do not, or have nothing to say.

    They do if heights are hardly better known than the reach says (images agree at none of them) although there is
    texture: residuals are larger than what the pixels of each image show to be noise, or than noise of any camera.
    """
    sigma, (squares, redundancy) = median(totals["sigmas"]), (np.array(totals[k]) for k in ("squares", "redundancy"))
    noise = np.reshape(totals["noise"], (-1, 3))
    known = (redundancy > 0) & (noise[:, 2] > 0)
    if sigma is None or not known.any() or sigma < _LOST * plan.scheme.reach:
        return ""
    if sigma < _VAGUE * plan.height_error * 2**plan.scheme.base:
        return ""
    sigma0 = np.sqrt(squares[known] / redundancy[known])
    own, mean = np.sqrt(noise[known, 0] / noise[known, 2]), noise[known, 1] / noise[known, 2]
    misfits = totals["misfits"] / max(totals["heights"], 1)
    beyond_own, beyond_any = (float(np.median(sigma0 / np.maximum(other, 1e-9))) for other in (own, mean))
    if beyond_own < _CONTENT and beyond_any < _NO_NOISE and misfits < _MOST_MISFIT:
        return ""
    return (
        f"the images contradict it: their median standard deviation of a height is {sigma:.3g} m where the reach is "
        f"{plan.scheme.reach:.3g} m, and residuals of {float(np.median(sigma0)):.3g} grey values are no noise. They "
        "show different things, orientations are wrong (`photoplan check`, `photoplan tie`, `photoplan adjust`), or "
        "the start is farther away than its reach (`start`, `reach`)"
    )


def _of_images(plan: SurfacePlan, sigma0: dict[str, float | None], contrast: float) -> Iterator[str]:
    """What standard deviations of grey values tell."""
    known = {name: value for name, value in sigma0.items() if value is not None}
    others = {
        name: float(np.median([v for other, v in known.items() if other != name])) for name in known if len(known) > 2
    }
    # Of others too few pixels tell, or those of margins alone.
    judged = [name for name in others if plan.parts.get(name, 1.0) > HARDLY]
    alone = [name for name in judged if known[name] > _ALONE * others[name]]
    usual = float(np.median([*known.values()])) if known else 0.0
    if not known:
        yield (
            "there is no height: within `reach` of the start (`start`) no two images see the same, or the start has no "
            "heights there. `photoplan check` tells where each image lies"
        )
    if alone:
        listed = ", ".join(f"{name} {known[name]:.3g} ({others[name]:.3g})" for name in alone[:6])
        whose, them = "its orientation is wrong, or it shows something else", "it"
        if len(alone) > 1:
            whose, them = "their orientations are wrong, or they show something else", "them"
        yield (
            f"sigma0 of {listed} is far above that of the other images (in brackets): {whose}. `photoplan tie` and "
            f"`photoplan adjust` orient anew; `images` leaves {them} out"
        )
    elif contrast > 0 and usual > _NOISY * contrast:
        coarse = ", the relief is finer than `resolution`" if plan.scheme.base else ""
        yield (
            f"sigma0 is {usual / contrast:.0%} of the contrast of the ground: images do not show the same, or no "
            f"texture. Orientations are wrong (`photoplan tie`, `photoplan adjust`){coarse}, or the start was too far "
            "away (`start`, `reach`)"
        )


def _of_fits(plan: SurfacePlan, misfit_share: float, astray: float) -> Iterator[str]:
    """What heights tell that fit badly, or went too far."""
    if misfit_share > _MISFITS:
        searched = plan.scheme.search is not None
        helps = "`search`, or a better `start` with a smaller `reach`"
        if searched:
            reach = f"a larger `reach` where things stand more than {plan.scheme.reach:.3g} m above or below the start"
            helps = f"{reach}, `target` where walls are seen"
        yield (
            f"{misfit_share:.1%} of the heights fit badly: see {plan.settings.name}_fit.tif. They lie at edges and "
            "moving things, or in regions that went wrong; their standard deviations are as large as what heights do "
            f"around them, so mask by these ({plan.settings.name}_sigma.tif). What helps: a finer `resolution`, {helps}"
        )
    if astray > _ASTRAY:
        yield (
            f"{astray:.1%} of the posts have no height since it would lie farther from the start than 1.5 times "
            "`reach`: give a larger one if the start is that wrong; if not, the images contradict the start there"
        )


def _of_moves(plan: SurfacePlan, correction: float, sigma_px: float | None) -> Iterator[str]:
    """What the last corrections tell."""
    # Reduced images are all that a coarse surface sees: their pixels count.
    pixel = 2**plan.scheme.base
    if correction > _MOVING * pixel:
        # Noise moves heights by no more than their standard deviations; what is more, facets cannot follow.
        noisy = sigma_px is not None and correction < _NOISE_MOVES * sigma_px
        helps = (
            "coarser `resolution` helps, as noise moves"
            if noisy
            else "finer `resolution` helps, as relief is finer than"
        )
        yield f"the last corrections were {correction:.2g} px: heights had not settled; a {helps} them"


def _of_noise(plan: SurfacePlan, sigma_px: float | None, misfit_share: float) -> Iterator[str]:
    """What the median standard deviation of the heights tells."""
    if sigma_px is None or not sigma_px > _VAGUE * 2**plan.scheme.base:
        return
    part = sigma_px * plan.height_error / plan.scheme.reach
    if part > _LOST:
        yield (
            f"the median standard deviation is {sigma_px:.2g} px of parallax, {part:.0%} of the reach: images agree on "
            "no height there. The start is farther away (`start`, `reach`), there is hardly any texture, or "
            "orientations are wrong (`photoplan tie`, `photoplan adjust`)"
        )
    elif misfit_share < _MOST_MISFIT:
        yield (
            f"the median standard deviation is {sigma_px:.2g} px of parallax: hardly any texture tells heights. What "
            "images do not determine follows its surroundings; mask it by the standard deviations, or choose a coarser "
            "`resolution`"
        )
