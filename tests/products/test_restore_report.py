"""The report of a restoration: what it says of filters and images, and when it is refused."""

from __future__ import annotations

import json
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
from tools.blurred_scenes import any_edges, sharpness, taken
from tools.command import Here

from photoplan.errors import UsageError
from photoplan.io.raster import RasterReader
from photoplan.products.measured_filter import DesignedPart
from photoplan.products.restore import FoundFilter, RestoreRequest, requested_filter
from photoplan.quality.restoration.design import DesignOptions, design_filter
from photoplan.quality.restoration.restorer import FilterKernel, RestorationFilter, SceneStatistics
from photoplan.report.files import open_report
from photoplan.report.restore import (
    axis_pictures,
    compare,
    distinct_kernels,
    distinct_parts,
    field_maps,
    origin,
    part_name,
    part_rows,
    plain_facts,
)

pytestmark = pytest.mark.usefixtures("searched_once")

PNG = "data:image/png;base64,"


@pytest.fixture
def photoplan(capsys: pytest.CaptureFixture[str]) -> Here:
    return Here(capsys)


def write(path: Path, bands: np.ndarray, dtype: str = "uint8", **form: object) -> Path:
    profile = {"width": bands.shape[2], "height": bands.shape[1], "count": bands.shape[0], "dtype": dtype}
    with rasterio.open(path, "w", driver="GTiff", **profile, **form) as file:
        file.write(np.clip(np.rint(bands), 0, 65535 if dtype == "uint16" else 255).astype(dtype))
    return path


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A blurred scene."""
    rng = np.random.default_rng(31)
    seen, _ = taken(any_edges(rng, 208), 0.5, rng)
    return write(tmp_path_factory.mktemp("scene") / "scene.tif", seen[None])


@pytest.fixture(scope="module")
def found(scene: Path) -> FoundFilter:
    """A filter in two by two parts, measured."""
    return requested_filter(RestoreRequest((scene,), cells=2, most_edges=30, method="regularised"))


def test_the_expected_curve_is_mtf_times_response(found: FoundFilter) -> None:
    part = found.measured.parts[0]
    picture = axis_pictures(part)[0]
    # By the transform of the filter itself, column sums along a row.
    size = 200
    line = np.zeros(size)
    sums = part.design.kernel.sum(axis=0)
    line[: sums.size] = sums
    response = np.abs(np.fft.rfft(line))
    curve = part.sharpness[0].modulation()
    frequency = np.fft.rfftfreq(size)
    expected = np.interp(frequency, curve.frequency, curve.modulation) * response
    assert np.interp(picture.frequency, frequency, expected) == pytest.approx(picture.expected, abs=1e-9)
    assert picture.spread == pytest.approx(part.sharpness[0].spread.side())


def test_an_exact_inverse_is_expected_to_lift_the_curve_to_that_of_whole_pixels() -> None:
    """MTF × response = MTF / transfer of the discrete spread function: for Gaussian blur it passes 1."""
    both = (sharpness(0.4), sharpness(0.5))
    scene = SceneStatistics(0.01, 0.05)
    design = design_filter(*both, (scene,), DesignOptions("exact", "separable"))
    pictures = axis_pictures(DesignedPart(None, None, 9, both, (), scene, design))
    for one, picture in zip(both, pictures):
        curve = one.modulation()
        exact = np.interp(picture.frequency, curve.frequency, curve.modulation)
        exact = exact / np.abs(one.spread.transfer(picture.frequency))
        assert picture.expected == pytest.approx(exact, abs=0.02)
        assert exact.max() > 1.1
    assert np.abs(pictures[0].expected - pictures[1].expected).max() > 0.05


def test_facts_of_a_measured_filter(found: FoundFilter) -> None:
    parts = [p for p in found.measured.parts if p.edges]
    drawn = distinct_parts(found.measured.parts)
    rows = [row for part in drawn for row in part_rows(part)]
    assert (
        origin(found)
        == "The filter was measured at edges of scene.tif. Linearisation: linear: grey values are taken as light."
    )
    assert len(rows) == 2 * len(drawn) and len(drawn) >= len(parts)
    row = dict(zip(("part", "edges", "method", "along", "Z"), rows[0]))
    first = found.measured.parts[0]
    assert row["Z"] == f"{first.sharpness[0].spread.side()[0]:.3f}"
    assert rows[0][7] == f"{first.design.condition_x.neighbour_ratio:.3f}"
    assert drawn[0].design.reason == first.design.reason
    ((name, maps),) = field_maps(found.filter, found.measured)
    assert name == "all bands" and [m.values.shape for m in maps] == [(2, 2)] * 3
    gains = [k.noise_gain for k in found.filter.kernels]
    assert maps[0].values.ravel() == pytest.approx(gains)
    known = [p.edges > 0 and "y" not in p.missing for p in found.measured.parts]
    mtf50 = [p.sharpness[1].modulation().mtf50 if k else np.nan for p, k in zip(found.measured.parts, known)]
    assert maps[2].values.ravel() == pytest.approx(mtf50, nan_ok=True)


def test_parts_without_edges_are_named_once_and_stay_empty_in_the_map(found: FoundFilter) -> None:
    measured = found.measured
    whole = replace(measured.parts[0], missing=())
    poor = tuple(replace(p, edges=0, design=whole.design, sharpness=whole.sharpness) for p in measured.parts[1:])
    kernels = tuple(FilterKernel(whole.design.kernel, p.at) for p in measured.parts)
    filter_ = RestorationFilter(kernels, found.filter.image_size)
    measured = replace(measured, parts=(whole, *poor))
    assert [part_name(part) for part in distinct_parts(measured.parts)] == ["at 52, 52", "whole field"]
    assert [name for name, _ in distinct_kernels(filter_)] == ["at 52, 52 and 3 more"]
    assert np.isfinite(field_maps(filter_, measured)[0][1][1].values).sum() == 1


def test_filters_of_files_and_apertures_say_where_they_come_from(tmp_path: Path) -> None:
    (tmp_path / "one.txt").write_text("1\n")
    made = requested_filter(RestoreRequest(tmp_path, tmp_path / "one.txt"))
    assert origin(made) == f"The filter comes from the file {tmp_path / 'one.txt'}."
    assert made.measured is None and field_maps(made.filter, None) == []
    made = requested_filter(RestoreRequest(tmp_path, aperture="round:1.2"))
    assert "aperture of a scanner, round:1.2" in origin(made)
    first = plain_facts(made.filter)[0]
    assert first[0] == "rule" and "Ecker 1991" in first[1]


def test_the_detail_shows_the_place_of_largest_contrast(tmp_path: Path) -> None:
    """A chess board in one corner of a ramp; invalid pixels, however wild, do not count."""
    ground = np.tile(np.linspace(60, 180, 700), (500, 1))
    ground[330:500, 530:690] += 40 * (np.indices((170, 160)).sum(0) % 2)
    ground[:100, :100] = 255 * (np.indices((100, 100)).sum(0) % 2)
    bad = np.zeros((500, 700), bool)
    bad[:100, :100] = True
    before = write(tmp_path / "before.tif", ground[None])
    after = write(tmp_path / "after.tif", np.clip(2 * ground - 120, 0, 255)[None])
    for path in (before, after):
        with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True), rasterio.open(path, "r+") as file:
            file.write_mask(~bad)
    seen = compare(RasterReader(before), RasterReader(after))
    assert (seen.window.col, seen.window.row) == (540, 340)
    assert seen.before.shape == seen.after.shape == (160, 160)
    assert (seen.after != seen.before).any()
    assert [e[0] for e in seen.ends.edges] == [-0.5, 239.5] and seen.ends.edges[1][-1] == 255.5
    valid = np.clip(2 * ground - 120, 0, 255)[~bad]
    share = 100 * np.mean(np.rint(valid) == 255)
    assert seen.ends.after[1][-1] == pytest.approx(share, rel=0.1)
    assert seen.ends.before[1].sum() < 0.1


@pytest.mark.parametrize("dtype", ["uint16", "float32"])
def test_ends_of_other_types_are_those_that_occur(tmp_path: Path, dtype: str) -> None:
    rng = np.random.default_rng(1)
    values = rng.uniform(100, 4095, (1, 170, 90))
    path = tmp_path / "image.tif"
    with rasterio.open(path, "w", driver="GTiff", width=90, height=170, count=1, dtype=dtype) as file:
        file.write(values.astype(dtype))
    reader = RasterReader(path)
    seen = compare(reader, reader)
    (low, high) = (e[[0, -1]] for e in seen.ends.edges)
    stored = values.astype(dtype)
    assert low[0] == pytest.approx(stored.min(), abs=0.6) and high[1] == pytest.approx(stored.max(), abs=0.6)
    inside = 100 * np.mean((stored >= low[0]) & (stored < low[1]))
    assert seen.ends.before[0].sum() == pytest.approx(inside, abs=0.05)
    assert seen.before.shape == (160, 90)


def test_a_report_that_exists_or_is_none_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "report.html"
    path.write_text("mine")
    with pytest.raises(UsageError, match="exists"):
        open_report(path, (), overwrite=False)
    with pytest.raises(UsageError, match=r"ends in \.html"):
        open_report(tmp_path / "report.tif", (), overwrite=False)
    assert open_report(path, (), overwrite=True).path == path
    with pytest.raises(UsageError, match="input"):
        open_report(path, (path,), overwrite=True)


def test_without_matplotlib_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.setitem(sys.modules, "matplotlib.cm", None)
    with pytest.raises(UsageError, match=r"photoplan\[report\].*leave the report out"):
        open_report(tmp_path / "report.html", (), overwrite=False)


class TestCommand:
    @pytest.mark.drawn
    def test_a_measured_restoration(self, photoplan: Here, scene: Path, tmp_path: Path) -> None:
        report = tmp_path / "report.html"
        words = ("restore", scene, "--output", tmp_path / "a", "--cells", 2, "--workers", 1, "--report", report)
        (tmp_path / "none.txt").write_text("1\n")  # measured twice would take twice as long
        dry = ("--filter", tmp_path / "none.txt", "--report", report, "--dry-run")
        assert photoplan(*words[:4], *dry).code == 0
        assert not report.exists() and not (tmp_path / "a").exists()
        said = photoplan(*words)
        assert said.code == 0, said.err
        assert said.out.splitlines() == [str(tmp_path / "a" / "scene_restored.tif"), str(report)]
        html = report.read_text("utf-8")
        assert "Restoration: scene.tif" in html and "Rule: " in html and "singular values" in html
        assert "Over the field" in html and "A detail of scene.tif" in html and "Ends of the histogram" in html
        assert html.count(PNG) >= 2 + 1 + 1 + 2
        assert not re.search(r"<script|https?://", html)
        again = photoplan(*words)
        assert again.code == 2 and str(report) in again.err and "exists" in again.err

    def test_the_report_of_a_filter_file_and_the_path_in_json(
        self, photoplan: Here, scene: Path, tmp_path: Path
    ) -> None:
        (tmp_path / "sharper.txt").write_text("0 -0.2 0\n-0.2 1.8 -0.2\n0 -0.2 0\n")
        report = tmp_path / "report.html"
        words = ("restore", scene, tmp_path / "no.tif", "--filter", tmp_path / "sharper.txt", "--json")
        said = photoplan(*words, "--output", tmp_path / "a", "--report", report)
        assert said.code == 4, said.err
        assert json.loads(said.out)["report"] == str(report)
        html = report.read_text("utf-8")
        assert "sharper.txt" in html and "Images without result" in html and "no.tif" in html
        assert "Sharpness" not in html
        (clipped,) = json.loads(said.out)["images"]
        assert f'<td class="number">{clipped["clipped_above"][0]}</td>' in html
        said = photoplan(*words, "--output", tmp_path / "b")
        assert json.loads(said.out)["report"] is None
