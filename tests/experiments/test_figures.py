"""Every figure of the documentation can be drawn."""

import pytest

mpl = pytest.importorskip("matplotlib")


@pytest.mark.parametrize(
    ("name", "sizes"),
    [
        ("one-idea", {}),
        ("linear-prediction", {"steps": 21}),
        ("anchor-interpolation", {"steps": 5}),
        ("homogeneous-anchors", {"steps": 3}),
        ("resampling-kernels", {"steps": 21}),
        ("anchor-residual", {"samples": 3, "steps": 3}),
        pytest.param("road-edge", {}, marks=pytest.mark.slow),
        ("marks", {}),
        pytest.param("true-orthophoto", {"resolution": 2.0}, marks=pytest.mark.slow),
        ("pyramid-strip", {"lines": 500, "columns": 400}),
    ],
)
def test_figure(name, sizes, tmp_path):
    import draw

    path = tmp_path / f"{name}.png"
    draw.FIGURES[name](**sizes).savefig(path, dpi=40)
    assert path.stat().st_size > 2000


def test_every_figure_is_listed_here_and_committed():
    from pathlib import Path

    import draw

    folder = Path(__file__).resolve().parents[2] / "docs" / "figures"
    assert {f"{name}.png" for name in draw.FIGURES} <= {p.name for p in folder.iterdir()}
