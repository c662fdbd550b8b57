"""Balance files: written, read, edited, refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from photoplan.errors import InputError
from photoplan.io.quality_files import BalanceBand, read_balance_file, write_balance_file
from photoplan.project.steps import load_balance

BAND = BalanceBand(
    grey=(0.0, 128.0, 255.0), becomes=(12.5, 140.0, 240.0), sigma=(2.0, 0.5, 3.0), trend=((1, 0, 0.125),)
)


def test_what_is_written_is_read(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    write_balance_file(path, (40, 30), 'a "name"', [BAND, BAND])
    entry = read_balance_file(path)
    assert entry.bands == (BAND, BAND) and entry.size == (40, 30) and entry.description == 'a "name"'
    step = load_balance(path)
    np.testing.assert_allclose(step.tones[0].table([0, 128, 255]), BAND.becomes)
    step.check((40, 30), 2)
    with pytest.raises(InputError, match=r"30 × 40 pixels, 2 bands; the tables in .* run `photoplan balance` again"):
        step.check((30, 40), 2)


def test_curves_and_small_numbers_are_written_and_read(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    curve = {"curve_grey": (0.01, 0.5), "curve_light": (0.0, 0.6)}
    band = BalanceBand(grey=(0.0, 0.12345), becomes=(0.00123, 0.25), **curve)
    write_balance_file(path, (40, 30), "", [band])
    assert read_balance_file(path).bands[0].curve_light == curve["curve_light"]
    (tone,) = load_balance(path).tones
    np.testing.assert_allclose(tone.table([0.0, 0.12345]), [0.00123, 0.25], atol=1e-6)
    np.testing.assert_allclose(tone.light([0.01, 0.5]), [0.0, 0.6])
    text = path.read_text("utf-8")
    for old, new, words in (
        ("curve_light = [0.00000, 0.60000]", "", "curve_light"),
        ("curve_light = [0.00000, 0.60000]", "curve_light = [0.7, 0.6]", "may not fall"),
        ("curve_grey = [0.01000, 0.50000]", "curve_grey = [0.5, 0.5]", "must rise"),
    ):
        assert old in text
        path.write_text(text.replace(old, new), "utf-8")
        with pytest.raises(InputError, match=words):
            load_balance(path)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("becomes = [12.50, 140.00, 240.00]", "becomes = [12.5, 140, 130]", "band 1: grey 128 becomes 140, but 255"),
        ("becomes = [12.50, 140.00, 240.00]", "becomes = [12.5, 140]", "3 entries of grey, but 2 of becomes"),
        ("grey = [0.00,", "grey = [nan,", "grey"),
        ("photoplan balance 1", "photoplan balance 9", "format"),
        ("trend = [[1, 0,", "trend = [[-1, 0,", "trend"),
        ("[[bands]]", "[[band]]", "band"),
    ],
)
def test_files_that_cannot_be_used_are_refused_by_entry(tmp_path: Path, old: str, new: str, words: str) -> None:
    path = tmp_path / "a.toml"
    write_balance_file(path, (40, 30), "", [BAND])
    text = path.read_text("utf-8")
    assert old in text
    path.write_text(text.replace(old, new), "utf-8")
    with pytest.raises(InputError, match=words) as error:
        load_balance(path)
    assert str(path) in str(error.value)
