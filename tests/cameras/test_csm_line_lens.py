"""Distortions in support data of line cameras: values of the USGS's implementation, figures by hand, the way back."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tools.body_axes import over_its_body

from photoplan.cameras.base import project
from photoplan.cameras.pushbroom import LineCamera
from photoplan.errors import InputError
from photoplan.io.camera.line import look, read_csm
from photoplan.io.camera.satellite import Isd

#: Support data of the USGS's ale (public domain), every fortieth and thirty-second record of their tables.
DATA = Path(__file__).parents[1] / "data/csm_line"
#: Other distortions put into those of Kaguya's Terrain Camera.
EDITED: dict[str, dict[str, Any]] = {
    "edited_transverse": {
        "transverse": {
            "x": [0.01, 1.001, 2e-3, 1e-5, -3e-5, 2e-5, 1e-7, 2e-7, -3e-7, 1e-7],
            "y": [-0.02, -1e-3, 0.998, -2e-5, 1e-5, 4e-5, 3e-7, -1e-7, 2e-7, -4e-6],
        }
    },
    "edited_radtan": {"radtan": {"coefficients": [-0.08, 0.12, 1e-3, -2e-3, 0.05]}},
}


def support_data(name: str) -> dict[str, Any]:
    base: dict[str, Any] = json.loads((DATA / f"{'kaguya_tc' if name in EDITED else name}.json").read_text())
    return base | {"optical_distortion": EDITED[name]} if name in EDITED else base


def camera_of(isd: dict[str, Any]) -> LineCamera:
    return over_its_body(read_csm(isd, Path("strip.json")))


@pytest.mark.parametrize("name", ["kaguya_tc", "kaguya_mi", *EDITED])
def test_image_to_ground_and_back_are_those_of_the_reference_implementation(name: str) -> None:
    """Asked: 1e-4 px, and 1e-5 px back. Places beside the axis, where Kaguya's curve is sharp, are among them."""
    camera = camera_of(support_data(name))
    table = np.loadtxt(DATA / f"{name}.points.txt")
    xy, ground, directions = table[:, 1::-1] - 0.5, table[:, 3:6], table[:, 6:9]
    d = camera.body_rays(xy)[1]
    off = float(np.linalg.norm(d - directions, axis=1).max() / camera.look.pitch)
    back = float(np.abs(project(camera, ground) - xy).max())
    print(f"\n{name}: rays {off:.1e} px, back {back:.1e} px")
    assert off < 2e-8
    assert back < 2e-9


def turned_over(isd: dict[str, Any], tables: bool) -> dict[str, Any]:
    """The support data of the image with its last line first; `tables`: those of poses run backwards, too."""
    lines, (line, began, lasts) = isd["image_lines"], isd["line_scan_rate"][0]
    found = isd | {"line_scan_rate": [[line, began + lasts * (lines + 1 - 2 * line), -lasts]]}
    if tables:
        for name in ("instrument_position", "instrument_pointing", "body_rotation"):
            rows = ("ephemeris_times", "positions", "velocities", "quaternions", "angular_velocities")
            entry = found[name]
            found[name] = entry | {k: entry[k][::-1] for k in rows if k in entry}
    return found


@pytest.mark.parametrize("tables", [False, True])
@pytest.mark.parametrize("name", ["kaguya_tc", "kaguya_mi"])
def test_lines_may_run_backwards(name: str, tables: bool) -> None:
    isd = support_data(name)
    camera, other = camera_of(isd), camera_of(turned_over(isd, tables))
    xy = np.loadtxt(DATA / f"{name}.points.txt")[:, 1::-1] - 0.5
    flipped = np.column_stack([xy[:, 0], isd["image_lines"] - 1 - xy[:, 1]])
    (S, d), (S_other, d_other) = camera.body_rays(xy), other.body_rays(flipped)
    assert np.linalg.norm(d - d_other, axis=1).max() < 1e-6 * camera.look.pitch
    assert np.abs(S - S_other).max() < 1e-5
    ground = np.loadtxt(DATA / f"{name}.points.txt")[:, 3:6]
    np.testing.assert_allclose(project(other, ground), flipped, atol=1e-5)
    # A record that goes to and fro is refused.
    table = isd["instrument_position"]["ephemeris_times"]
    mixed = isd | {"instrument_position": isd["instrument_position"] | {"ephemeris_times": [table[1], *table[1:]]}}
    with pytest.raises(InputError, match="neither rise nor fall throughout"):
        camera_of(mixed)


def distorted(kind: str, entries: dict[str, Any], base: str = "kaguya_tc") -> dict[str, Any]:
    return support_data(base) | {"optical_distortion": {kind: entries}}


@pytest.mark.parametrize(
    "isd",
    [
        support_data("kaguya_tc"),
        support_data("kaguya_mi"),
        support_data("edited_radtan"),
        distorted("kplo_shadowcam", {"coefficients": [1.81e-5]}),
        distorted("themisir", {"p_alpha1": 0.00447623, "p_alpha2": 0.00107556, "p_k": 0.996005}),
    ],
    ids=["kaguya_tc", "kaguya_mi", "radtan", "kplo_shadowcam", "themisir"],
)
def test_positions_and_rays_are_inverse(isd: dict[str, Any]) -> None:
    """Asked: 1e-8 px; over the image, and closely around the axis."""
    camera = camera_of(isd)
    width, height = camera.size
    xy = np.random.default_rng(4).uniform((-0.5, -0.5), (width - 0.5, height - 0.5), (400, 2))
    axis = float(camera.look.column(np.zeros(1))[0])
    xy[:100, 0] = np.clip(axis + np.linspace(-3.0, 3.0, 100), -0.5, width - 0.5)
    S, d = camera.body_rays(xy)
    worst = np.abs(project(camera, S + 1.1e5 * d) - xy).max()
    print(f"\n{worst:.1e} px")
    assert worst < 1e-8


@pytest.mark.parametrize(("name", "kind"), [("kaguya_tc", "kaguyalism"), ("edited_radtan", "radtan")])
def test_focal_length_and_distortion_are_told(name: str, kind: str) -> None:
    told = read_csm(support_data(name), Path("strip.json")).describe()["focal length"]
    assert told == f"{support_data(name)['focal_length_model']['focal_length']:.6g} mm, distortion {kind}"


def seen(kind: str, entries: dict[str, Any], place: tuple[float, float]) -> NDArray[np.float64]:
    """Where detectors look, in millimetres, of a line whose first detector lies at a place; they are 1 mm apart."""
    isd = distorted(kind, entries) | {
        "focal_length_model": {"focal_length": 100.0},
        "image_samples": 5,
        "focal2pixel_lines": [0.0, 1.0, 0.0],
        "focal2pixel_samples": [0.0, 0.0, 1.0],
        "detector_center": {"line": -place[0], "sample": 0.5 - place[1]},
        "starting_detector_line": 0,
        "starting_detector_sample": 0,
    }
    return 100.0 * look(Isd(isd, Path("strip.json"))).tangents(np.arange(5.0))


def test_figures_by_hand() -> None:
    """The distance of the place (3, 4) from the axis is 5, of (3, -4) too."""
    powers = {"x": [0.5, 0.01, 0.002, 0.0004], "y": [-0.5, 0.02, 0.004, -0.0008]}
    kaguya = powers | {"boresight_x": 0.25, "boresight_y": -0.125}
    # 0.5 + 0.05 + 0.05 + 0.05 = 0.65 and −0.5 + 0.1 + 0.1 − 0.1 = −0.4 come on top, and the boresight.
    assert seen("kaguyalism", kaguya, (3.0, 4.0))[0] == pytest.approx([3.9, 3.475], abs=1e-9)
    assert seen("kaguyalism", kaguya, (3.0, -4.0))[0] == pytest.approx([3.9, -4.525], abs=1e-9)
    # In the axis itself nothing but the constant parts.
    assert seen("kaguyalism", kaguya, (0.0, -2.0))[2] == pytest.approx([0.75, -0.625], abs=1e-9)
    # 2 (1 + 0.1 · 4)
    assert seen("kplo_shadowcam", {"coefficients": [0.1]}, (1.5, 2.0))[0] == pytest.approx([1.5, 2.8], abs=1e-9)
    # 1.5 · 2 + 0.25 · 4 = 4
    themis = {"p_alpha1": 0.5, "p_alpha2": 0.25, "p_k": 0.5}
    assert seen("themisir", themis, (1.5, 4.0))[0] == pytest.approx([3.0, 2.0], abs=1e-9)


@pytest.mark.parametrize(
    ("kind", "entries", "said"),
    [
        ("legendre", {"x_coefficients": [0.0] * 20, "y_coefficients": [0.0] * 20}, "'legendre' is not known"),
        ("kaguyalism", {"x": [0.0] * 4, "y": [0.0] * 3, "boresight_x": 0, "boresight_y": 0}, "has 3 numbers, not 4"),
        ("kaguyalism", {"x": [0.0] * 4, "y": [0.0] * 4, "boresight_x": 0}, "boresight_y is missing"),
        ("kplo_shadowcam", {"coefficients": [1e-5, 0.0]}, "has 2 numbers, not 1"),
        ("themisir", {"p_alpha1": 0.0, "p_alpha2": 0.0, "p_k": 0.0}, "a scale, above 0"),
        ("themisir", {"p_alpha1": 0.0, "p_alpha2": 5.0, "p_k": 1.0}, "no direction"),
    ],
)
def test_other_numbers_are_refused_by_name(kind: str, entries: dict[str, Any], said: str) -> None:
    with pytest.raises(InputError, match=said):
        camera_of(distorted(kind, entries))
