"""Edges are found where they are, with the pixels that belong to them; what cannot be measured is rejected by name."""

from __future__ import annotations

from math import atan2, degrees

import numpy as np
import pytest
from tools.edge_scenes import blocks, half_plane, noisy
from tools.thinned import some

from photoplan.errors import InputError
from photoplan.quality.edges.find import EdgePicture, EdgeRegion, EdgeRules, find_edges, find_lines, noise_of


def one_edge(angle: float = 8.0, sigma: float = 0.8, snr: float = 50.0, size: tuple[int, int] = (90, 80)) -> np.ndarray:
    scene = 0.25 + 0.5 * half_plane(size, (44.3, 40.2), angle, sigma)
    return noisy(scene, snr, 5, "float32")


def reasons(grey: np.ndarray, **masks: np.ndarray) -> dict[str, int]:
    found, rejected = find_edges(EdgePicture(grey, **masks))
    assert not found
    return dict(rejected)


class TestFound:
    @pytest.mark.parametrize("angle", [43.0, 44.0, 45.0, 46.0, 136.0, -44.5])
    def test_diagonal_edges_do_not_break(self, angle: float) -> None:
        """Noise decides there whether rows or columns hold the ridge: SNR 20, one line from border to border."""
        scene = 0.25 + 0.5 * half_plane((160, 150), (80.3, 75.2), angle, 0.8)
        lines, _ = find_lines(noisy(scene, 20, 3, "float32"), None, 20.0)
        assert len(lines) == 1 and lines[0].length > 190.0

    @pytest.mark.parametrize("angle", [0.0, 3.0, -17.0, 45.0, 78.0, 90.0, 131.0, -160.0])
    def test_where_it_is(self, angle: float) -> None:
        """Through (44.3, 40.2), whatever its direction: within 0.1 pixel and 0.5 degrees; bright on its right."""
        found, _ = find_edges(EdgePicture(one_edge(angle)))
        assert len(found) == 1
        line = found[0].line
        off = (44.3 - line.x) * -line.ty + (40.2 - line.y) * line.tx
        turned = (degrees(atan2(line.tx, -line.ty)) - angle + 180) % 360 - 180
        print(f"{angle:g} degrees: off {off:.3f} px, turned {turned:.3f} degrees, {line.length:.0f} px long")
        assert abs(off) < 0.1
        assert abs(turned) < 0.5
        assert line.length > 38

    @pytest.mark.parametrize(("size", "sides"), some([((330, 330), 36), ((660, 550), 120)], 0))
    def test_all_sides_of_all_blocks(self, size: tuple[int, int], sides: int) -> None:
        """Turned rectangles with noise: each of their sides once, no other."""
        found, rejected = find_edges(EdgePicture(noisy(blocks(size, 12.0, 0.8, 3), 50, 4, "float32")))
        print(f"{len(found)} of {sides} sides, rejected {dict(rejected)}")
        assert len(found) == sides

    def test_pixels_of_the_mask(self) -> None:
        """They lie within half a width of the line, between its ends, outside gaps; both sides are equal in number."""
        region = find_edges(EdgePicture(one_edge(20.0)))[0][0]
        col, row, *_ = window = region.window((90, 80))
        i, j = np.nonzero(region.mask(window))
        dx, dy = j + col - region.line.x, i + row - region.line.y
        across = dy * region.line.tx - dx * region.line.ty
        along = dx * region.line.tx + dy * region.line.ty
        assert np.abs(across).max() <= region.half
        assert np.abs(along).max() <= region.line.length / 2
        assert (across > 0).mean() == pytest.approx(0.5, abs=0.05)
        gap = EdgeRegion(region.line, region.half, 1.0, 1.0, False, gaps=((-3.0, 3.0),))
        window = gap.window((90, 80))
        assert gap.mask(window).sum() == pytest.approx(region.mask(window).sum() - 6 * 2 * region.half, rel=0.03)

    def test_aligned_ones_are_told(self) -> None:
        assert find_edges(EdgePicture(one_edge(0.0)))[0][0].aligned
        assert find_edges(EdgePicture(one_edge(90.3)))[0][0].aligned
        assert not find_edges(EdgePicture(one_edge(3.0)))[0][0].aligned

    def test_behind_a_spot_it_goes_on(self) -> None:
        grey = one_edge(10.0, size=(90, 160))
        grey[96:101, 42:47] += 0.3
        region = find_edges(EdgePicture(grey))[0][0]
        assert region.line.length > 120
        assert len(region.gaps) in (1, 2)
        (col, row, width, height) = region.window((90, 160))
        assert not region.mask((col, row, width, height))[98 - row, 44 - col]

    def test_noise_is_estimated(self) -> None:
        """White noise on a slope: within 10 percent."""
        rng = np.random.default_rng(2)
        slope = np.add.outer(np.linspace(0, 20, 256), np.linspace(0, 30, 256))
        estimate = noise_of((slope + rng.normal(0, 2.0, slope.shape)).astype(np.float32))
        print(f"noise 2: estimated {estimate:.3f}")
        # The lowest fifth of the blocks' medians lies a few percent below their mean.
        assert estimate == pytest.approx(2.0, rel=0.1)


class TestRejected:
    def test_nothing_in_noise(self) -> None:
        rng = np.random.default_rng(1)
        found, rejected = find_edges(EdgePicture(rng.normal(0.5, 0.05, (300, 300)).astype(np.float32)))
        assert not found
        assert sum(rejected.values()) < 4

    def test_texture(self) -> None:
        """Grains of 3 to 8 pixels with 17 % of the contrast on the bright side, 50 times: at most a sixth passes.

        What passes lies by chance where the texture is even; the measurement tests it once more.
        """
        passed, why = 0, set()
        edge, bright = one_edge(), half_plane((90, 80), (44.3, 40.2), 8, 0.8) > 0.5
        for seed in range(10):
            for size in (3, 4, 5, 6, 8):
                rng = np.random.default_rng(seed)
                grain = np.kron(rng.uniform(-0.15, 0.15, (30, 33)), np.ones((size, size)))[:80, :90]
                grey = edge + np.where(bright, grain, 0)
                found, rejected = find_edges(EdgePicture(grey.astype(np.float32)))
                passed += bool(found)
                why |= set(rejected)
        print(f"{passed} of 50 edges beside texture pass, the others are {sorted(why)}")
        assert passed <= 8
        assert "textured" in why

    def test_a_bar_has_two_sides(self) -> None:
        bar = half_plane((90, 80), (42.0, 40.0), 8, 0.8) - half_plane((90, 80), (47.0, 40.0), 8, 0.8)
        assert "two_sided" in reasons(noisy(0.25 + 0.5 * bar, 50, 5, "float32"))

    def test_saturated(self) -> None:
        grey = np.minimum(one_edge(), 0.7).astype(np.float32)
        assert reasons(grey, saturated=grey >= 0.7) == {"saturated": 1}

    def test_weak(self) -> None:
        assert "weak" in reasons(one_edge(snr=6.0))

    def test_curved(self) -> None:
        y, x = np.mgrid[:160, :160]
        disc = 1 / (1 + np.exp((np.hypot(x - 80, y - 80) - 55) / 0.5))
        assert set(reasons((0.2 + 0.5 * disc).astype(np.float32))) == {"curved"}

    def test_blurred(self) -> None:
        assert "blurred" in reasons(one_edge(sigma=9.0, size=(120, 80)))

    def test_invalid(self) -> None:
        grey = one_edge(0.0)
        valid = np.ones(grey.shape, bool)
        valid[:, 48:] = False
        assert set(reasons(grey, valid=valid)) <= {"invalid", "two_sided"}

    def test_uniform_and_tiny_pictures(self) -> None:
        assert reasons(np.full((50, 50), 0.5, np.float32)) == {}
        assert find_lines(np.zeros((3, 3), np.float32), None, 20.0)[0] == []

    def test_rules_are_checked(self) -> None:
        with pytest.raises(InputError, match="least length of an edge 2 px"):
            EdgeRules(least_length=2.0)
        with pytest.raises(InputError, match="least contrast over noise 1"):
            EdgeRules(least_snr=1.0)
        with pytest.raises(InputError, match="rows and columns"):
            EdgePicture(np.zeros((2, 3, 4), np.float32))
