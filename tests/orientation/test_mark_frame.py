"""Marks that are the outline of the camera's frame, with image content beside them, found in a whole scan."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest
from pydantic import TypeAdapter
from scipy import ndimage
from tools.mark_scans import ArrayScan

from photoplan.cameras import marks
from photoplan.orientation.marks.fiducials import FiducialSearch, find_fiducials
from photoplan.orientation.marks.locate import MarkLayout, coverage
from photoplan.project.camera_marks import mark_pattern

MARKS = tomllib.loads((Path(__file__).parents[1] / "real" / "usgs_marks" / "marks.toml").read_text())
PLACES = {"T": (0.01, 40.0), "B": (-0.01, -40.01), "L": (-40.0, 0.02), "R": (40.01, 0.0)}


@pytest.mark.parametrize(
    ("kind", "negative", "allowed"),
    [pytest.param("ee_block", False, 0.3, marks=pytest.mark.slow), ("nagap_triangle", True, 0.8)],
)
def test_silhouettes_are_placed_by_their_edges_and_tell_how_the_scan_is_turned(
    kind: str, negative: bool, allowed: float
) -> None:
    mark = TypeAdapter(marks.Mark)
    patterns = {name: mark_pattern(mark.validate_python(v), Path()) for name, v in MARKS[kind].items()}
    rng = np.random.default_rng(3)
    pixel, t, n = 0.05, np.radians(1.2), 1900
    R = np.array([[np.cos(t), -np.sin(t)], [np.sin(t), np.cos(t)]]) @ np.diag([1, -1.0]) / pixel
    noise = rng.normal(size=(2, n, n))
    content = 0.55 + 1.2 * ndimage.gaussian_filter(noise[0], 3) + 3 * ndimage.gaussian_filter(noise[1], 12)
    rows, columns = np.indices((n, n))
    mm = (np.stack([columns, rows], -1) - (n - 1) / 2) @ np.linalg.inv(R).T
    tone = np.where(np.abs(mm).max(-1) > 40, 0.05, content)
    truth = {}
    for name, pattern in patterns.items():
        truth[name] = R @ np.array(PLACES[name]) + (n - 1) / 2
        x0, y0, x1, y1 = pattern.window
        x, y = (mm - PLACES[name])[..., 0], (mm - PLACES[name])[..., 1]
        box = (x > x0) & (x < x1) & (y > y0) & (y < y1)
        (top, bottom), (left, right) = ((k[0], k[-1] + 1) for k in (np.flatnonzero(box.any(axis)) for axis in (1, 0)))
        cut = np.s_[top:bottom, left:right]
        tone[box] = content[box]
        for part in pattern.parts:
            share = coverage(part.outline @ R.T + truth[name] - (left, top), tone[cut].shape) * box[cut]
            bright = content[cut] if np.isnan(part.tone) else np.maximum(content[cut], 0.35)
            tone[cut] = tone[cut] * (1 - share) + (0.05 if part.tone < 0.5 else bright) * share
    grey = 30 + 200 * ndimage.gaussian_filter(np.clip(tone, 0, 1), 1.0) + rng.normal(0, 5, (n, n))
    layout = MarkLayout.of(PLACES, patterns)
    found = find_fiducials(ArrayScan(255 - grey if negative else grey), layout, FiducialSearch(pixel))
    assert found.negative == negative
    assert str(found.turn) == "0°"
    assert not found.missing
    off = np.array([(m.x, m.y) - truth[m.name] for m in found.marks])
    assert np.abs(off).max() < allowed
    sigmas = np.array([(m.sigma_x, m.sigma_y) for m in found.marks])
    assert np.sqrt(np.mean((off / sigmas) ** 2)) < 3
    assert sum(m.method == "edges" for m in found.marks) >= 3
