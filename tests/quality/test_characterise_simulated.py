"""Fall-off, line jitter and gain control recovered from images of the formation model, with all of its noise."""

from __future__ import annotations

import math

import numpy as np
import pytest
from tools.formed import form_image, form_series

from photoplan.quality.camera.fall_off import FallOffSettings, fit_fall_off
from photoplan.quality.camera.geometry import correlate_edge, fit_edge
from photoplan.quality.camera.video import gain_control, line_jitter
from photoplan.quality.formation.model import ImageModel
from photoplan.quality.formation.optics import (
    AutomaticGain,
    Exposure,
    Falloff,
    FixedPattern,
    Gain,
    LineJitterPart,
    Quantisation,
    Readout,
    Spread,
)
from photoplan.quality.formation.scenes import PatternScene


def camera(**parts: object) -> ImageModel:
    """Shot noise, read noise, fixed pattern and 8 bits: 40 electrons for a grey value, black at 8."""
    usual: dict[str, object] = {
        "exposure": Exposure(light=40.0),
        "readout": Readout(shot_noise=True, noise=15.0),
        "fixed_pattern": FixedPattern(response=0.005, offset=5.0),
        "gain": Gain(factor=1 / 40.0, offset=8.0),
        "quantisation": Quantisation(8),
    }
    return ImageModel(**{**usual, **parts})  # type: ignore[arg-type]


def flat(size: tuple[int, int], level: float) -> PatternScene:
    return PatternScene("flat", size, levels=(0.0, level), oversampling=1)


def test_fall_off_of_the_model() -> None:
    """cos⁴ω, vignetting 1 − 0.12 ρ⁴ and a tilt of the light, from eight frames with their dark frames."""
    size, centre = (320, 240), (165.0, 118.0)
    falloff = Falloff(350.0, centre, artificial=0.12, power=4.0, polynomial=((0, 0, 1.0), (1, 0, 0.06)))
    model = camera(falloff=falloff)
    frames = np.mean([form_image(model, flat(size, 220.0), k).values.astype(float) for k in range(8)], axis=0)
    dark = np.mean([form_image(model, flat(size, 0.0), k, exposure=0.0).values.astype(float) for k in range(8)], axis=0)
    found = fit_fall_off(frames - dark, FallOffSettings("given", 350.0, centre))
    u, v = (np.array([0.0, 319, 0, 319]) - 165) / 200, (np.array([0.0, 0, 239, 239]) - 118) / 200
    square = u**2 + v**2
    want = 1 - (1 + square * (200 / 350) ** 2) ** -2 * (1 - 0.12 * square**2) * (1 + 0.06 * u)
    terms = {(t.n, t.m): (t.coefficient, t.sigma) for t in found.terms}
    for corner, w in zip(found.corners, want):
        print(f"{corner.name}: {100 * corner.total:.2f} ± {100 * corner.sigma:.2f} %, put in {100 * w:.2f} %")
        assert abs(corner.total - w) < max(5 * corner.sigma, 0.002)
    assert abs(terms[1, 1][0] - 0.06) < 5 * terms[1, 1][1]
    assert found.rank == "" and not found.dirt


def test_line_jitter_of_the_model() -> None:
    """Independent displacements, an offset of the fields, and an oscillation of 120 lines."""
    put_in = LineJitterPart(sigma=0.15, field=0.12, amplitude=0.25, period=120.0, phase_deg=40.0)
    model = camera(spread=Spread(gaussian=(0.6, 0.6)), jitter=put_in)
    scene = PatternScene("edge", (48, 480), (0.5,), levels=(40.0, 200.0), oversampling=4)
    image = form_image(model, scene)
    lines = fit_edge(image.values, saturation=255.0)
    turned = math.tan(math.radians(0.5)) * (np.arange(480) - 239.5)
    moved = lines.position + turned - image.line_shift
    print(f"\npositions: error {np.std(moved):.4f} px, stated {np.nanmean(lines.sigma):.4f} px")
    # Shot noise is larger on the bright side than the even noise of the adjustment.
    assert 0.8 < np.std(moved) / np.nanmean(lines.sigma) < 1.3
    found = line_jitter(lines.position)
    h = found.harmonics[0]
    print(f"amplitude {h.amplitude:.3f} ± {h.sigma_amplitude:.3f}, period {h.period:.1f} ± {h.sigma_period:.1f} lines")
    print(f"fields {found.field_offset:.3f} ± {found.sigma_field_offset:.3f}, residual {found.residual_sigma:.3f} px")
    assert abs(h.amplitude - 0.25) < 4 * h.sigma_amplitude and abs(h.period - 120) < 4 * h.sigma_period
    assert abs(math.remainder(h.phase - math.radians(40), math.tau)) < 4 * h.sigma_phase
    assert abs(found.field_offset - 0.12) < 4 * found.sigma_field_offset and found.fields_differ
    assert found.residual_sigma == pytest.approx(0.15, rel=0.12)
    assert found.slope == pytest.approx(-math.tan(math.radians(0.5)), abs=2e-4)
    by_correlation = line_jitter(correlate_edge(image.values, lines).position)
    assert by_correlation.sigma == pytest.approx(found.sigma, rel=0.1)


def test_gain_control_of_the_model() -> None:
    """The gain's own law is exponential in time, so size and time constant of the change are known exactly."""
    size = (24, 24)
    model = camera(automatic_gain=AutomaticGain(target=100.0, frames=5.0, least=0.5, most=1.4))
    scenes = [flat(size, 100.0)] * 10 + [flat(size, 60.0)] * 50
    means = np.array([image.values.mean() for image in form_series(model, scenes)])
    times = np.arange(60) * 0.04
    found = gain_control(times, means)
    a = found.approach
    assert a.change is not None and a.sigma_change is not None
    assert a.time_constant is not None and a.sigma_time_constant is not None
    # Above black 60 grey values at gain 1 become 60 · 1.4.
    print(f"\nchange {a.change:.2f} ± {a.sigma_change:.2f}, put in 24")
    print(f"time constant {a.time_constant:.3f} ± {a.sigma_time_constant:.3f} s, put in 0.2")
    assert found.direction == "bright to dark" and found.first == 10
    assert abs(a.change - 24.0) < 4 * a.sigma_change
    assert abs(a.time_constant - 0.2) < 4 * a.sigma_time_constant
