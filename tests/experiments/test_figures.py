"""Every figure of the documentation can be drawn."""

import pytest

mpl = pytest.importorskip("matplotlib")


@pytest.mark.parametrize(
    ("name", "sizes"),
    [
        ("one-idea", {}),
        ("linear-prediction", {"steps": 21}),
        ("anchor-interpolation", {"steps": 5}),
        pytest.param("homogeneous-anchors", {"steps": 3}, marks=pytest.mark.slow),
        ("resampling-kernels", {"steps": 21}),
        pytest.param("anchor-residual", {"samples": 3, "steps": 3}, marks=pytest.mark.slow),
        pytest.param("road-edge", {}, marks=pytest.mark.slow),
        pytest.param("marks", {}, marks=pytest.mark.slow),
        pytest.param("true-orthophoto", {"resolution": 2.0}, marks=pytest.mark.slow),
        pytest.param("pyramid-strip", {"lines": 500, "columns": 400}, marks=pytest.mark.slow),
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
