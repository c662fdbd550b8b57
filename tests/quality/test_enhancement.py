"""Edge enhancement is recognised by several edges, and is not seen where there is none (Kölbl 2006, §4.2-4.3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from tools.edge_scenes import half_plane, noisy

from photoplan.errors import InputError
from photoplan.quality.edges.groups import enhancement_of
from photoplan.quality.edges.response import measure_edge


@dataclass(frozen=True)
class Edge:
    overshoot: float
    undershoot: float
    overshoot_sigma: float = 0.01
    undershoot_sigma: float = 0.01


def measured(amount: float, snr: float = 40.0) -> list[object]:
    """Four edges of an image that was sharpened by a mask of 1.5 pixels."""
    edges = []
    for k, angle in enumerate((6.0, 97.0, -12.0, 171.0)):
        scene = 0.25 + 0.5 * half_plane((60, 60), (29.7, 30.2), angle, 0.8)
        image = noisy(scene, snr, k, "float32").astype(float)
        edges.append(measure_edge(image + amount * (image - gaussian_filter(image, 1.5))))
    return edges


@pytest.mark.parametrize(("amount", "enhanced"), [(0.0, False), (0.5, True), (1.0, True)])
def test_sharpened_images_are_recognised(amount: float, enhanced: bool) -> None:
    found = enhancement_of(measured(amount))  # type: ignore[arg-type]
    print(f"mask {amount}: size {found.size:.4f} ± {found.sigma:.4f}, {found.warning[:60]}")
    assert found.enhanced is enhanced
    assert found.edges == 4
    assert bool(found.warning) is enhanced
    if enhanced:
        # The mask's own overshoot, without noise.
        at = np.arange(60.0)
        profile = half_plane((60, 1), (29.5, 0.0), 0.0, 0.8)[0]
        sharp = profile + amount * (profile - gaussian_filter(np.tile(profile, (60, 1)), 1.5)[30])
        assert at.size == 60
        assert found.size == pytest.approx(sharp.max() - 1.0, abs=0.02)
        assert "restoration is limited" in found.warning
        assert found.json_fields()["enhanced"] is True


def test_noisy_edges_without_enhancement() -> None:
    assert not enhancement_of(measured(0.0, snr=12.0)).enhanced  # type: ignore[arg-type]


def test_one_wild_edge_is_no_proof() -> None:
    edges = [Edge(0.0, 0.0), Edge(0.005, 0.0), Edge(0.0, 0.004), Edge(0.5, 0.4), Edge(0.003, 0.0), Edge(0.0, 0.0)]
    assert not enhancement_of(edges).enhanced
    assert enhancement_of([Edge(0.10, 0.08), Edge(0.12, 0.06), Edge(0.09, 0.07)]).enhanced


def test_few_edges_are_told_and_none_refused() -> None:
    assert "by 1 edge only" in enhancement_of([Edge(0.10, 0.08)]).warning
    assert enhancement_of([Edge(0.10, 0.08), Edge(float("nan"), 0.0)]).edges == 1
    with pytest.raises(InputError, match="without a measured edge"):
        enhancement_of([])
