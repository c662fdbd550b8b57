"""One edge measured: figures of ideal edges recovered, refusals where no figure can be known."""

from __future__ import annotations

import numpy as np
import pytest
from tools.edges import edge_image, gaussian, true_fwhm, true_mtf50

from photoplan.quality.edge_response import measure_edge


@pytest.mark.parametrize("angle", [5.0, 33.0, 84.0, 187.0, 265.0])
def test_noise_free_edge_is_recovered_without_bias(angle):
    spread = gaussian(0.7)
    image = edge_image((90, 90), angle, (44.3, 45.1), spread, (20.0, 180.0))
    image += np.random.default_rng(3).normal(0.0, 0.05, image.shape)
    edge = measure_edge(image, origin=(100.0, 200.0))
    assert edge.mtf50 == pytest.approx(true_mtf50(angle, spread), rel=1e-3)
    assert edge.fwhm == pytest.approx(true_fwhm(angle, spread), rel=1e-3)
    assert (edge.angle_deg - angle + 180.0) % 360.0 - 180.0 == pytest.approx(0.0, abs=0.01)
    assert edge.dark == pytest.approx(20.0, abs=0.05) and edge.bright == pytest.approx(180.0, abs=0.05)
