"""The report of a bundle adjustment: true figures, safe text, and check points after the standard."""

from __future__ import annotations

import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest

from photoplan.orientation.bundle.model import Group
from photoplan.orientation.intersection import check_accuracy
from photoplan.products.adjust.findings import (
    AdjustReport,
    CorrectionFigures,
    GroundFigures,
    ImageFigures,
    NamedMeasurement,
    ResidualField,
    StripFigures,
)
from photoplan.products.adjust.sensors import Calibrated, FoundParameter
from photoplan.report.adjust import adjust_page, draw_control

pytest.importorskip("matplotlib")

HOSTILE = '<script>alert("1")</script><img src=x onerror=alert(1)>\u202e $\\frac{1}{0}$ ]]>'
NAN = float("nan")


class Page(HTMLParser):
    """Tags, addresses and text of a document."""

    def __init__(self, document: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.addresses: list[str | None] = []
        self.words: list[str] = []
        self.feed(document)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.addresses += [v for k, v in attrs if k in ("src", "href", "srcset", "action", "data")]

    def handle_data(self, data: str) -> None:
        self.words.append(data)


def facts(name: str = "p") -> AdjustReport:
    """A made-up block: twelve images in two strips, nine ground points of which four are checked."""
    random = np.random.default_rng(1)
    images = tuple(
        ImageFigures(
            f"{name}{k}",
            "ab"[k // 6],
            50,
            int(k == 3),
            (0.01, -0.02),
            (0.3, 0.25),
            3.1,
            (690_000.0 + 300 * (k % 6), 5_350_000.0 + 500 * (k // 6), 1700.0),
            (0.05, 0.06, 0.04),
            (0.001, 0.001, 0.0005),
        )
        for k in range(12)
    )
    ground = tuple(
        GroundFigures(
            f"{name} G{k}",
            k >= 5,
            6 if k else 0,
            (690_000.0 + 600 * (k % 3), 5_350_000.0 + 250 * (k // 3), 500.0),
            (0.03, -0.02, 0.05) if k else (NAN, NAN, NAN),
            (0.02, 0.02, 0.03),
            (1.0, 0.5, 2.0),
            (False, False, k == 2),
            np.diag([4e-4, 9e-4, 1e-3]),
        )
        for k in range(9)
    )
    check = [g for g in ground if g.check]
    return AdjustReport(
        title=f"Block {name}",
        crs="EPSG:25832",
        sigma0=1.02,
        redundancy=900,
        unknowns=300,
        iterations=7,
        seconds=1.5,
        rms_pixels=0.28,
        measurements=600,
        rejected=2,
        points=69,
        mean_rays=4.2,
        angle_unit="gon",
        groups=(
            Group(f"image points, camera {name}", 1200, 850.0, 0.28, "px", 1.01),
            Group("observed attitudes", 36, 9.0, np.pi / 200, "rad", 0.9),
        ),
        images=images,
        corrections=(
            CorrectionFigures(
                name=f"{name} nadir",
                group="lines",
                measurements=9,
                rejected=1,
                mean=(0.0, 0.1),
                rms=(0.2, 0.3),
                worst=2.5,
                parameters=(FoundParameter("boresight x", 0.03, 0.001, "°"),),
                seconds=np.arange(9.0),
                residuals=np.zeros((9, 2)),
                over_time=(np.arange(5.0), np.full((5, 6), 1e-4)),
                angles=(np.arange(5.0), np.full((5, 3), 1e-2)),
            ),
        ),
        ground=ground,
        check=check_accuracy(np.array([g.residual for g in check]), np.array([g.stated for g in check])),
        cameras=(
            Calibrated(
                name,
                ("c", "x0"),
                ("mm", "mm"),
                np.array([153.0, 0.0]),
                np.array([153.0123, 0.0042]),
                np.outer((0.0021, 0.0013), (0.0021, 0.0013)) * np.array([[1.0, 0.93], [0.93, 1.0]]),
                np.eye(2),
            ),
        ),
        strips=(
            StripFigures(
                name,
                6,
                1,
                (0.0, 0.0, 0.01),
                (0.05, 0.04, 0.06),
                (0.1, 0.2, -0.3),
                (3e-3,) * 3,
                (0.01,) * 3,
                (4e-4,) * 3,
            ),
            StripFigures(
                "b", 6, 0, (0.0, 0.0, 0.0), (0.05, 0.04, 0.06), (NAN,) * 3, (NAN,) * 3, (NAN,) * 3, (NAN,) * 3
            ),
        ),
        lever_arm=((0.1, 0.2, 1.3), (0.01, 0.01, 0.02)),
        boresight=((0.1, 0.2, 0.3), (0.01, 0.01, 0.02)),
        gross=(NamedMeasurement(f"point {name!r} in image 'a'", "+3.00 -1.00 px", 9.5, True),),
        worst=(NamedMeasurement("point 'k' in image 'a'", "+0.80 -0.10 px", 3.6, False),),
        left_out=((name, "point seen in one image only"),),
        normalised=random.normal(size=1200),
        critical=4.0,
        robust=True,
        tie_XY=random.uniform((690_000.0, 5_350_000.0), (691_500.0, 5_351_000.0), (400, 2)),
        point_sigma=(0.05, 0.05, 0.08),
        fields=(
            ResidualField(
                name,
                "mm",
                np.array([(x, y) for x in range(-100, 101, 20) for y in range(-100, 101, 20)], float),
                random.normal(scale=0.05, size=(121, 2)),
                np.full(121, 25),
                (-115.0, -115.0, 115.0, 115.0),
                0.28,
            ),
        ),
        notes=(f"a note of {name}",),
        inputs=((name, f"/data/{name}"),),
        settings=(("gross errors", "beyond 4 standard deviations"),),
    )


@pytest.mark.drawn
def test_it_holds_everything_and_reaches_for_nothing() -> None:
    document = adjust_page(facts())
    page = Page(document)
    assert all(address and address.startswith("data:image/png;base64,") for address in page.addresses)
    assert page.tags.count("img") == 8
    words = " ".join(page.words)
    for said in ("1.020", "RMSE_H", "ASPRS", "Edition 2 (2023)", "4 check points; the standard asks for at least 30"):
        assert said in words, said
    assert "c and x0" not in words
    assert "x0 and c (+0.93)" in words
    assert "153.0123" in words
    assert "1 gon" in words  # π / 200 radians
    assert "0.050*" in words
    assert "95 % confidence ellipses" in words


def test_gross_errors_of_control_do_not_set_the_scale_in_which_the_others_are_drawn() -> None:
    given = facts()
    wrong = replace(given.ground[2], residual=(2.0, -1.5, 2.5), rejected=(True, True, True))
    changed = replace(given, ground=(*given.ground[:2], wrong, *given.ground[3:]))
    assert draw_control(changed, check=False)[1] == draw_control(given, check=False)[1]
    assert "What was taken out as a gross error has no arrow." in " ".join(Page(adjust_page(changed)).words)


def test_fault_11_hostile_names_are_shown_and_not_obeyed() -> None:
    document = adjust_page(facts(HOSTILE))
    page = Page(document)
    assert "script" not in page.tags
    assert page.tags.count("img") == 8
    assert "\u202e" not in document
    assert any("<script>" in words for words in page.words)
    assert re.search(r"default-src 'none'", document)


def test_a_block_with_nothing_but_images() -> None:
    """No control, no check points, no strips, no covariances: sections are left out, nothing is NaN."""
    poor = replace(
        facts(),
        ground=(),
        check=None,
        cameras=(),
        strips=(),
        lever_arm=None,
        boresight=None,
        gross=(),
        worst=(),
        left_out=(),
        fields=(),
        normalised=np.full(10, NAN),
        tie_XY=np.empty((0, 2)),
        point_sigma=(NAN,) * 3,
        images=tuple(replace(i, sigma_center=(NAN,) * 3, sigma_angles=(NAN,) * 3, worst=NAN) for i in facts().images),
    )
    document = adjust_page(poor)
    assert "nan" not in " ".join(Page(document).words).lower()
    assert "Check points" not in document
    assert "None was found." in document
    one = replace(poor, images=poor.images[:1])
    assert adjust_page(one)


def test_check_points_after_the_standard() -> None:
    """RMSE_H and RMSE_V with the survey's own error, worked by hand."""
    residuals = np.array([[0.3, 0.0, 0.1], [-0.3, 0.4, -0.1], [NAN, NAN, 0.2], [0.0, -0.4, NAN]])
    sigma = np.full((4, 3), 0.06)
    found = check_accuracy(residuals, sigma)
    assert (found.horizontal, found.vertical) == (3, 3)
    np.testing.assert_allclose(found.mean, [0.0, 0.0, 0.2 / 3], atol=1e-15)
    np.testing.assert_allclose(found.rmse, [np.sqrt(0.06), np.sqrt(0.32 / 3), np.sqrt(0.02)])
    np.testing.assert_allclose(found.fit_h, np.sqrt(0.06 + 0.32 / 3))
    np.testing.assert_allclose(found.survey_h, 0.06 * np.sqrt(2))
    np.testing.assert_allclose(found.rmse_h, np.sqrt(0.06 + 0.32 / 3 + 2 * 0.06**2))
    np.testing.assert_allclose(found.rmse_v, np.sqrt(0.02 + 0.06**2))
    np.testing.assert_allclose(found.rmse_3d, np.hypot(found.rmse_h, found.rmse_v))
    assert [w.split(":")[0].split(";")[0] for w in found.warnings] == [
        "3 check points",
        "the mean error in Z is more than a quarter of the RMSE",
    ]
    unknown = check_accuracy(residuals, np.full((4, 3), NAN))
    np.testing.assert_allclose(unknown.rmse_h, unknown.fit_h)
    assert "accuracy of the survey is not stated" in unknown.warnings[-1]


@pytest.mark.parametrize(("count", "warned"), [(29, True), (30, False)])
def test_thirty_check_points_are_enough(count: int, warned: bool) -> None:
    signs = np.resize([1.0, -1.0], count)[:, None]
    found = check_accuracy(0.1 * signs * np.ones(3), np.full((count, 3), 0.02))
    assert bool(found.warnings) == warned


def test_rates_of_a_drift_have_their_standard_deviations():
    assert "0.003 ± 0.0004" in "".join(Page(adjust_page(facts())).words)
