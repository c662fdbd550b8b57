"""EMVA 1288 figures of a published reduced measurement against the package `emva1288`.

Oracle: `emva1288` 0.6.3 (LGPL-3), run on the same 50 + 50 points with NumPy 2.4 and `np.asfarray` put back, which that
version needs; its own documentation (`datasets_results.rst`, read below) has the same figures. The package is no
dependency of the tests: 0.6.3 does not run with today's NumPy, 1.0.2 no longer reads these data, and both bring Pillow,
lxml and Jinja.
"""

from __future__ import annotations

import re

import numpy as np
import pytest
from tools.command import Here

from photoplan.io.series import StatisticsEntry, read_statistics
from photoplan.quality.camera.photon_transfer import EmvaPoints, EmvaSheet, emva_sheet

#: By `emva1288` 0.6.3.
ORACLE = {
    "quantum_efficiency_percent": 45.13560828330828,
    "gain": 0.28076928077579844,
    "responsivity": 0.12672692282094886,
    "temporal_dark_noise_dn": 3.0734184898051202,
    "temporal_dark_noise_e": 10.898027518759177,
    "saturation_photons": 30957.0,
    "saturation_e": 13972.630263995296,
    "threshold_photons": 25.36006602743577,
    "dynamic_range": 1220.6987145265784,
    "snr_max": 118.20588083507222,
}
LINEARITY = {
    "error_min_percent": -0.6157975811492923,
    "error_max_percent": 0.4804483327516668,
    "slope": 0.12629092922653423,
}


@pytest.fixture
def sheet(shared) -> EmvaSheet:
    file = shared / "data" / "emva_reduced_example" / "EMVA1288_image_data.txt"
    points = read_statistics(file, StatisticsEntry(file=file.name, format="emva1288"))
    bright = [p for p in points if p.kind == "flat"]
    dark = {p.exposure_ms: p for p in points if p.kind == "dark"}
    assert (len(bright), len(dark)) == (50, 50)
    assert [bright[0].mean, bright[0].variance] == pytest.approx([30.97, 13.93], abs=0.005)
    assert [bright[1].mean, bright[1].variance] == pytest.approx([138.30, 45.56], abs=0.005)
    pairs = [dark[p.exposure_ms] for p in bright]
    return emva_sheet(
        EmvaPoints(
            np.array([p.photons_per_pixel for p in bright], float),
            np.array([p.mean for p in bright]),
            np.array([p.variance for p in bright]),
            np.array([d.mean for d in pairs]),
            np.array([d.variance for d in pairs]),
            np.array([p.pixels - 1 for p in bright], float),
            np.array([np.sqrt((p.variance + d.variance) / 2 / p.pixels) for p, d in zip(bright, pairs)]),
        )
    )


@pytest.mark.parametrize("name", ORACLE)
def test_figure_equals_the_oracle(sheet, name):
    found = getattr(sheet, name)
    print(f"{name}: {found:.8g} against {ORACLE[name]:.8g} ({100 * (found / ORACLE[name] - 1):+.4f} %, wanted 0.5 %)")
    assert found == pytest.approx(ORACLE[name], rel=0.005)


@pytest.mark.parametrize("name", LINEARITY)
def test_linearity_equals_the_oracle(sheet, name):
    assert getattr(sheet.linearity, name) == pytest.approx(LINEARITY[name], rel=1e-6)


def test_oracle_agrees_with_its_documentation(shared):
    text = (shared / "data" / "emva_reduced_example" / "datasets_results.rst").read_text("utf-8")
    for mine, tag in (("gain", "K"), ("quantum_efficiency_percent", "QE"), ("temporal_dark_noise_e", "sigma_d")):
        value = re.search(rf"<{tag}>.*?<Value>([^<]*)</Value>", text, re.S)
        assert value is not None
        assert ORACLE[mine] == pytest.approx(float(value[1]), rel=1e-6)


def test_command_on_reduced_figures(shared, tmp_path, capsys):
    file = shared / "data" / "emva_reduced_example" / "EMVA1288_image_data.txt"
    series = tmp_path / "s.toml"
    series.write_text(f'[camera]\nbits = 12\n[[statistics]]\nformat = "emva1288"\nfile = "{file}"\n')
    said = Here(capsys)("characterise", series)
    assert said.code == 0
    assert re.search(r"quantum efficiency η +45\.14 ± 0\.13 %", said.out)
    assert "not known: DSNU and PRNU: reduced figures hold no images" in said.out
    assert "fixed_pattern: missing:" in said.err
    # The package's 28.4074 e/s comes from an unweighted line.
    current = re.search(r"dark current +([0-9.]+) ± ([0-9.]+) e/s", said.out)
    assert current is not None and float(current[1]) == pytest.approx(28.4074, rel=0.005)
