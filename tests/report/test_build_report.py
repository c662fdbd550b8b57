"""The report of a built model: true figures, safe text, complete files, bounded work."""

import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from tools.sketched import drawn

from photoplan.errors import ResourceError
from photoplan.kernels.prediction import correlation
from photoplan.products.dtm.build import BuildReport
from photoplan.report import dtm as dtm_covariance
from photoplan.report import dtm as samples
from photoplan.report.dtm import build_page, draw_covariance, draw_filter_histograms, draw_heights
from photoplan.report.files import ReportFile
from photoplan.report.page import text
from photoplan.surfaces.units import MeasuredLine, MeasuredTerrain, PointGroup
from photoplan.terrain.build import build_terrain, plan_build
from photoplan.terrain.clean import Finding, clean
from photoplan.terrain.observations import FAMILIES, BuildSettings

pytest.importorskip("matplotlib")

HOSTILE = '<script>alert("1")</script><img src=x onerror=alert(1)>\u202e $\\frac{1}{0}$ ]]>'
NOISE = 0.05


class Page(HTMLParser):
    """Tags, addresses and text of a document."""

    def __init__(self, document):
        super().__init__()
        self.tags, self.addresses, self.words = [], [], []
        self.feed(document)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        self.addresses += [v for k, v in attrs if k in ("src", "href", "srcset", "action", "data")]

    def handle_data(self, data):
        self.words.append(data)


@pytest.fixture(scope="module")
def measured():
    """A slope with a noise of 5 cm, a breakline, and one point 3 m too high with a hostile name."""
    rng = np.random.default_rng(5)
    xy = rng.uniform(0, 100, (700, 2)) + np.array([300_000, 5_000_000])
    z = 200 + 0.1 * (xy[:, 0] - 300_000) + 0.6 * np.sin((xy[:, 1] - 5_000_000) / 9)
    z += rng.normal(0, NOISE, len(z))
    middle = int(np.hypot(*(xy - (300_050, 5_000_060)).T).argmin())
    z[middle] += 3.0
    names = np.array([f"P{k}" for k in range(len(z))], object)
    names[middle] = HOSTILE
    group = PointGroup("survey.csv", "mass", np.column_stack([xy, z]), np.arange(1, len(z) + 1), names=names)
    y = np.linspace(5, 95, 19)
    line = np.column_stack([np.full(19, 300_030.0), 5_000_000 + y, 203 + 0.6 * np.sin(y / 9)])
    lines = (MeasuredLine(f"edge {HOSTILE}", "breakline", line),)
    return clean(MeasuredTerrain((group,), lines, crs="EPSG:32633", notes=(f"note {HOSTILE}",)))[0]


@pytest.fixture(scope="module")
def built(measured):
    return build_terrain(plan_build(measured, BuildSettings(unit_meshes=16)))


@pytest.fixture(scope="module")
def model(built, measured):
    findings = [Finding("crossing heights", f"{HOSTILE} meets {k}", 300_010.0, 5_000_010.0) for k in range(60)]
    figures = {"seconds": 12.3}
    return BuildReport(
        path=Path("model.gpkg"),
        figures=figures,
        gross=(),
        suspects=(),
        findings=findings,
        built=built,
        measured=measured,
    )


@pytest.fixture(scope="module")
def facts(built, measured):
    return samples.samples_of(built, measured)


@pytest.fixture(scope="module")
def document(model, facts):
    with drawn():
        return build_page(model, (), facts)


def test_nothing_outside_the_document_is_asked_for(document):
    page = Page(document)
    assert len(page.addresses) == 7
    assert all(address.startswith("data:image/png;base64,") for address in page.addresses)
    assert not {tag for tag, _ in page.tags} & {"script", "link", "iframe", "object", "embed", "form", "a"}
    assert "url(" not in document and "@import" not in document
    policy = [attrs["content"] for tag, attrs in page.tags if attrs.get("http-equiv") == "Content-Security-Policy"]
    assert policy == ["default-src 'none'; img-src data:; style-src 'unsafe-inline'"]


def test_names_are_shown_and_not_obeyed(document):
    page = Page(document)
    assert not [attrs for _, attrs in page.tags if any(name.startswith("on") for name in attrs)]
    shown = "".join(page.words)
    assert shown.count('<script>alert("1")</script>') >= 3
    assert "\u202e" not in document


@pytest.mark.parametrize("character", ["\u202e", "\u2066", "\x00", "\x1b", "\ufeff"])
def test_characters_that_turn_or_hide_text_are_replaced(character):
    assert text(f"a{character}b") == "a\ufffdb"


def test_the_gross_error_is_listed_with_its_name_and_size(facts, document):
    assert len(facts.gross) == 1
    error = facts.gross[0]
    assert HOSTILE in error.name
    assert error.difference == pytest.approx(3.0, abs=0.15)
    assert abs(error.normalised) > 5
    assert text(error.name) in document and f"+{error.difference:.3f}" in document


def test_measured_minus_filtered_heights_are_the_noise(facts):
    mass, line = facts.effects
    assert (mass.name, mass.count) == ("mass points", 699)
    assert np.sqrt(np.nanmean(mass.differences**2)) == pytest.approx(NOISE, rel=0.15)
    assert line.name == "vertices of breaklines" and np.abs(line.differences).max() < 0.05
    # A point's place and its difference belong together: heights along x rise by a tenth.
    assert abs(np.corrcoef(mass.xy[:, 0], mass.differences)[0, 1]) < 0.15


def test_headline_figures(facts, built, document):
    whole, full = built.fit.whole, [f for f in built.figures if f.meshes > 0]
    assert whole.noise == pytest.approx(NOISE, rel=0.3)
    assert 0.8 < facts.spread < 1.2 and len(full) >= 9
    empty = f"{len(built.figures) - len(full)} units are empty"
    for words in ("mass points 700", str(len(full)), empty, "12.3 s", f"{whole.noise:.3f} m", whole.name):
        assert words in "".join(Page(document).words)


def test_the_map_lies_where_the_points_are(facts, built):
    from photoplan.surfaces.hybrid import HybridSurface
    from photoplan.surfaces.units import MemoryUnits

    area = facts.map
    left, right, bottom, top = area.extent
    assert left == pytest.approx(300_000, abs=15) and right == pytest.approx(300_100, abs=15)
    assert bottom == pytest.approx(5_000_000, abs=15) and top == pytest.approx(5_000_100, abs=15)
    surface = HybridSurface(MemoryUnits(built.plan.layout, built.units))
    row, column = 300, 200
    place = (left + (column + 0.5) * area.resolution, top - (row + 0.5) * area.resolution)
    assert area.heights[row, column] == pytest.approx(float(surface.heights(place)), abs=1e-3)
    assert area.sigmas[row, column] == pytest.approx(float(surface.sigmas(place)), abs=1e-4)


def test_many_findings_are_counted(document):
    assert "and 10 more of this kind" in document


@pytest.mark.slow
@pytest.mark.drawn
def test_the_same_model_has_the_same_report(model, facts, document):
    assert build_page(model, (), facts) == document


def test_every_plot_names_its_units(facts):
    """Axes of all plots: drawn again with the labels collected."""
    import matplotlib.axes

    seen = []
    original = matplotlib.axes.Axes.set

    def spy(self, **options):
        seen.extend(options[k] for k in ("xlabel", "ylabel") if k in options)
        return original(self, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(matplotlib.axes.Axes, "set", spy)
        draw_heights(facts.map), draw_covariance(facts.covariance), draw_filter_histograms(facts.effects)
    assert {"X m", "Y m", "distance m", "covariance cm²", "measured − filtered cm"} <= set(seen)


@pytest.mark.parametrize("family", FAMILIES)
def test_correlation_is_that_of_the_prediction(family):
    t = np.linspace(0, 4, 30)
    plain = getattr(correlation, "py_func", correlation)
    kernel = [plain(d**2, FAMILIES.index(family)) for d in t]
    np.testing.assert_allclose(dtm_covariance.correlation_at(family, t), kernel, atol=1e-12)


@pytest.mark.slow
def test_expected_products_are_the_mean_of_simulated_ones(built):
    """If the fitted function is the terrain's, residuals from the plane have just these products on average."""
    leaves = dtm_covariance._leaves(built.fit)
    leaf = next(leaf for leaf in leaves if len(dtm_covariance._block(built.fit, leaf)[0]))
    # As much noise as signal, so that either would be missed.
    fit = replace(built.fit, noise=np.where(built.fit.noise < 0, -1.0, built.fit.units[0].variance))
    _, _, expected = dtm_covariance._block(fit, leaf)
    seen = fit.seen
    points = fit.neighbours.near[0].tree.query(fit.leaves.middle[leaf], k=90)[1]
    points = fit.neighbours.near[0].numbers[points]
    covariance = dtm_covariance._matrix(fit, leaf, seen.xyz[points, :2])
    noise = np.sqrt(np.abs(fit.noise[points]))
    root = np.linalg.cholesky(covariance + 1e-9 * covariance[0, 0] * np.eye(len(points)))
    rng = np.random.default_rng(0)
    total, runs = np.zeros_like(expected), 3000
    for _ in range(runs):
        xyz = seen.xyz.copy()
        xyz[points, 2] = root @ rng.normal(size=len(points)) + noise * rng.normal(size=len(points))
        total += dtm_covariance._block(replace(fit, seen=replace(seen, xyz=xyz)), leaf)[1]
    mean = total / runs
    assert np.corrcoef(mean, expected)[0, 1] > 0.87
    slope = (mean * expected).sum() / (expected**2).sum()
    assert slope == pytest.approx(1.0, abs=0.08)


def test_neighbourhoods_that_a_breakline_parts_are_left_out(built):
    fit = built.fit
    middle = fit.leaves.middle + fit.seen.origin[:2]
    beside = np.abs(middle[:, 0] - 300_030)
    on_line = int(np.flatnonzero((fit.leaves.count > 3) & (np.abs(middle[:, 1] - 5_000_050) < 30) & (beside < 5))[0])
    far = int(np.flatnonzero((fit.leaves.count > 3) & (beside > 40) & (beside < 60))[0])
    assert len(dtm_covariance._block(fit, on_line)[0]) == 0
    assert len(dtm_covariance._block(fit, far)[0]) > 1000


def test_covariance_classes_use_all_pairs_once(facts, built):
    c = facts.covariance
    assert (np.diff(c.classes[c.pairs > 0]) > 0).all()
    whole = built.fit.whole
    assert c.whole[0] == pytest.approx(whole.variance)
    assert c.whole[np.argmin(np.abs(c.distance - whole.length))] == pytest.approx(whole.variance / 2, rel=0.05)
    assert (c.low <= c.high).all()


def test_covariances_that_differ_from_what_is_expected_are_told(model, facts):
    """Not by chance, not below the noise; in the page as in what the command prints."""
    good = facts.covariance
    assert 0.5 < good.ratio < 2 and good.warning == ""
    for factor, word in ((8.0, "too large"), (0.1, "too small")):
        bad = replace(good, empirical=good.expected / factor)
        assert bad.ratio == pytest.approx(1 / factor)
        assert f"{good.expected[0]:.3g} m²" in bad.warning and bad.warning.endswith(word)
        assert replace(bad, noise=1e3).warning == ""
    page = Page(build_page(model, (), replace(facts, covariance=bad)))
    assert bad.warning in page.words
    nothing = replace(good, empirical=good.empirical * np.nan, pairs=0 * good.pairs)
    assert np.isnan(nothing.ratio) and nothing.warning == ""


def test_settings_name_the_grid_that_is_built(document, built):
    finest = min(built.plan.layout.side / f.meshes for f in built.figures if f.meshes > 0)
    assert finest == built.plan.finest == built.plan.width / 2
    assert f"{built.plan.width:g} m, {finest:g} m where breaklines pass" in "".join(Page(document).words)


def test_a_full_disk_leaves_the_old_report(document, tmp_path, monkeypatch):
    import errno

    path = tmp_path / "model.report.html"
    path.write_text("old")
    page = ReportFile(path)

    def full(self, content):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(ResourceError):
        page.write(document)
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["model.report.html"]


def test_work_is_bounded(built, measured, monkeypatch):
    monkeypatch.setattr(samples, "_SAMPLE", 50)
    monkeypatch.setattr(samples, "_RESIDUALS", 60)
    monkeypatch.setattr(samples, "_VERTICES", 20)
    monkeypatch.setattr(samples, "_SIDE", 64)
    facts = samples.samples_of(built, measured)
    assert len(facts.effects[0].differences) <= 50 and facts.effects[0].count == 699
    assert len(facts.normalised) <= 60
    assert max(facts.map.heights.shape) <= 65
    assert sum(len(xy) for _, xy in facts.map.lines) <= 22


def test_file_is_named_and_titled_after_the_model(model, facts, tmp_path):
    path = tmp_path / "dam.report.html"
    source = tmp_path / "survey <1>.csv"
    source.write_text("x")
    ReportFile(path).write(build_page(replace(model, path=tmp_path / "dam.gpkg"), (source,), facts))
    page = path.read_text("utf-8")
    assert re.search("<h1>dam</h1>", page)
    assert "survey &lt;1&gt;.csv" in page
    assert [p.name for p in sorted(tmp_path.iterdir())] == ["dam.report.html", "survey <1>.csv"]
