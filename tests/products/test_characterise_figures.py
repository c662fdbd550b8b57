"""Figures as they are printed: digits by their standard deviation, no powers of ten without need."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from tools.camera_model import Sensor, write_frame

from photoplan.findings import Table, with_sigma
from photoplan.products.characterise.run import CharacteriseRequest, characterise


@pytest.mark.parametrize(
    ("value", "sigma", "text"),
    [
        (13710.4, 223.0, "13710 ± 220"),
        (0.76, 0.00037, "0.76000 ± 0.00037"),
        (31.0, 1.2, "31.0 ± 1.2"),
        (1.77218, 0.00091, "1.77218 ± 0.00091"),
        (5.0, math.nan, "5"),
        (1.234e-6, 1.1e-8, "1.234e-06 ± 1.1e-08"),
        (0.0003, 0.0123, "0.000 ± 0.012"),
        (120.83, 1.04, "120.8 ± 1.0"),
        (-1e-9, 1.0, "0.0 ± 1.0"),
        (15625.0, math.nan, "15625"),
    ],
)
def test_digits_follow_the_standard_deviation(value: float, sigma: float, text: str):
    assert with_sigma(value, sigma) == text


def test_columns_become_rows() -> None:
    table = Table.of("of them", plane="R", mean_dn=np.array([1.5, 2.5]), used=np.array([True, False]), name=["a", "b"])
    assert table == Table(("plane", "mean_dn", "used", "name"), (("R", 1.5, 1, "a"), ("R", 2.5, 0, "b")), "of them")


def test_defects_come_from_the_levels_with_most_frames(tmp_path: Path) -> None:
    """A mean of two frames hides what one of eight shows; of dark frames only long exposures show hot pixels."""
    sensor, noise = Sensor(shape=(32, 40)), np.random.default_rng(0)
    for kind, exposure, photons, frames in (
        ("dark", 10, 0.0, 12), ("dark", 800, 0.0, 8), ("dark", 1000, 0.0, 2),
        ("flat", 20, 9000.0, 2), ("flat", 25, 12000.0, 8), ("flat", 2, 500.0, 9),
    ):  # fmt: skip
        for k in range(frames):
            write_frame(tmp_path / f"{kind}_{exposure}ms_{k}.tif", sensor.frame(photons, exposure, noise))
    entries = "".join(f'[[frames]]\nkind = "{k}"\nfiles = "{k}_{{exposure}}ms_*.tif"\n' for k in ("dark", "flat"))
    (tmp_path / "s.toml").write_text(f"[camera]\nbits = 12\n{entries}")
    outcome = characterise(CharacteriseRequest(tmp_path / "s.toml", only=("defects",))).runs[0].outcome
    assert outcome is not None
    assert {f.at for f in outcome.figures if f.at} == {"dark 800 ms", "flat 25 ms"}
