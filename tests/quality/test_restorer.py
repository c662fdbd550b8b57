"""Applying a restoration filter: twins, tilings, borders, gaps, field, types, noise."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from photoplan.errors import InputError
from photoplan.geometry.grid import Window
from photoplan.quality.curves import Linearisation
from photoplan.quality.restoration.restorer import FilterKernel, RestorationFilter, Restorer, field_weights

TYPES = ("uint8", "uint16", "int16", "float32")
#: Inverse of the spread function 0.02, 0.15, 0.66, 0.15, 0.02 (Kölbl 2006, tab. 1), eleven elements.
SPREAD = np.array([0.02, 0.15, 0.66, 0.15, 0.02])


def inverse(half: int = 5) -> np.ndarray:
    """Middle row of the inverse of the band matrix, divided by its sum."""
    size = 41
    matrix = sum(value * np.eye(size, k=k - 2) for k, value in enumerate(SPREAD))
    row = np.linalg.inv(matrix)[size // 2, size // 2 - half : size // 2 + half + 1]
    return row / row.sum()


def sharpening(half: int = 5) -> RestorationFilter:
    return RestorationFilter((FilterKernel(np.outer(inverse(half), inverse(half))),))


def random_kernel(seed: int, shape: tuple[int, int] = (5, 7)) -> np.ndarray:
    values = np.random.default_rng(seed).normal(size=shape) * 0.1
    values[shape[0] // 2, shape[1] // 2] += 1
    return values


def restore(image, used, valid=None, side=None, out=None, light=None, order=None):
    """An image (bands, height, width) restored by tiles of a side; the clipped pixels of each band."""
    bands, height, width = image.shape
    kind = np.dtype(out or image.dtype)
    restorer = Restorer(used, (width, height), bands, image.dtype, kind, light or Linearisation())
    made = np.zeros(image.shape, kind)
    clipped = np.zeros((2, bands), int)
    tiles = list(Window(0, 0, width, height).tiles(side or max(width, height)))
    for i in order.permutation(len(tiles)) if order is not None else range(len(tiles)):
        window = tiles[i]
        at = restorer.margin.around(window, (width, height))
        part = np.s_[at.row : at.stop[1], at.col : at.stop[0]]
        pixels = restorer.restore(window, image[:, *part], at, None if valid is None else valid[part])
        made[:, window.row : window.stop[1], window.col : window.stop[0]] = pixels.values
        clipped += [pixels.below, pixels.above]
    return made, clipped


def scene(dtype, bands=2, size=(90, 70), seed=0):
    top = 1.0 if dtype == "float32" else 200 if dtype == "uint8" else 20_000
    values = np.random.default_rng(seed).uniform(0.2 * top, top, (bands, size[1], size[0]))
    return values.astype(dtype)


class TestValues:
    @pytest.mark.parametrize("dtype", TYPES)
    def test_inside_it_is_the_convolution_of_scipy_rounded(self, dtype):
        image = scene(dtype)
        values = random_kernel(1)
        made, _ = restore(image, RestorationFilter((FilterKernel(values),)))
        for band in range(2):
            exact = ndimage.convolve(image[band].astype(float), values)[3:-3, 4:-4]
            inner = made[band, 3:-3, 4:-4]
            if dtype == "float32":
                np.testing.assert_allclose(inner, exact, atol=2e-6)
            else:
                limits = np.iinfo(dtype)
                assert np.abs(inner - np.clip(exact, limits.min, limits.max)).max() <= 0.5 + 0.01

    def test_clipped_pixels_are_counted_for_each_band(self):
        image = np.full((2, 20, 30), 100, np.uint8)
        image[0, 10, 10], image[1, 10, 10:12] = 250, 0
        values = np.zeros((3, 3))
        values[1] = -1, 3, -1
        made, clipped = restore(image, RestorationFilter((FilterKernel(values),)))
        # Band 1: 3 · 250 − 200 = 550 above, its neighbours 300 − 350 = −50 below; band 2: two pixels of 0 − 100 below.
        assert clipped.tolist() == [[2, 2], [1, 0]]
        assert made[0, 10, 9:12].tolist() == [0, 255, 0]
        floating, none = restore(image, RestorationFilter((FilterKernel(values),)), out="float32")
        assert floating[0, 10, 9:12].tolist() == [-50, 550, -50]
        assert not none.any()
        wide, counted = restore(image, RestorationFilter((FilterKernel(values),)), out="uint16")
        assert wide[0, 10, 9:12].tolist() == [0, 550, 0] and counted.tolist() == [[2, 2], [0, 0]]

    def test_a_band_without_a_kernel_stays_as_it_is(self):
        image = scene("uint8", bands=3)
        own = RestorationFilter((FilterKernel(random_kernel(1), band=2),))
        made, _ = restore(image, own)
        assert np.array_equal(made[[0, 2]], image[[0, 2]])
        assert not np.array_equal(made[1], image[1])

    def test_the_filter_of_a_band_goes_before_that_of_all(self):
        image = scene("float32", bands=2)
        both = RestorationFilter((FilterKernel(random_kernel(1)), FilterKernel(random_kernel(2), band=2)))
        made, _ = restore(image, both)
        for band in (0, 1):
            alone, _ = restore(image[band : band + 1], RestorationFilter((FilterKernel(random_kernel(band + 1)),)))
            # The margin is that of the larger kernel; here both have one size.
            assert np.array_equal(made[band], alone[0])

    def test_a_filter_for_a_band_that_is_not_there(self):
        with pytest.raises(InputError, match="kernel for band 3; the image has 2"):
            restore(scene("uint8"), RestorationFilter((FilterKernel(random_kernel(1), band=3),)))


class TestTilings:
    @pytest.mark.parametrize("dtype", TYPES)
    @pytest.mark.parametrize("gaps", [False, True])
    def test_fault_26_identical_bytes_for_any_tiling(self, dtype, gaps):
        """General and even kernels, one and several places, with gaps and without: tiles of any side, in any order."""
        rng = np.random.default_rng(4)
        image = scene(dtype, seed=5)
        valid = None
        if gaps:
            valid = rng.random(image.shape[1:]) > 0.03
            valid[20:33, 40:] = False
        corners = [(10.0, 5.0), (80.0, 5.0), (10.0, 60.0), (80.0, 60.0)]
        filters = [
            RestorationFilter((FilterKernel(random_kernel(1)),)),
            sharpening(),
            RestorationFilter(
                tuple(FilterKernel(random_kernel(i, (5, 5)), at) for i, at in enumerate(corners)), (90, 70)
            ),
            RestorationFilter(
                tuple(FilterKernel(random_kernel(i, (3, 5)), at) for i, at in enumerate(corners[:3])), (90, 70)
            ),
        ]
        for used in filters:
            whole, clipped = restore(image, used, valid)
            for side in rng.integers(5, 80, 4):
                made, counted = restore(image, used, valid, int(side), order=rng)
                assert made.tobytes() == whole.tobytes()
                assert np.array_equal(counted, clipped)


class TestBorders:
    @pytest.mark.parametrize("dtype", TYPES)
    def test_a_constant_image_stays_constant(self, dtype):
        image = np.full((1, 40, 50), 1 if dtype == "float32" else 97, dtype)
        made, _ = restore(image, sharpening())
        np.testing.assert_allclose(made, image, rtol=3e-7 if dtype == "float32" else 0)

    def test_a_linear_ramp_stays_linear(self):
        y, x = np.mgrid[:40, :50]
        ramp = (3.0 * x - 2.0 * y + 100)[None].astype(np.float32)
        made, _ = restore(ramp, sharpening())
        np.testing.assert_allclose(made, ramp, atol=2e-4)

    @pytest.mark.parametrize("axis", [0, 1])
    def test_along_an_edge_the_outermost_pixel_keeps_its_value(self, axis):
        """Odd mirroring leaves nothing to sharpen across the edge: no ringing, and no more noise than there was."""
        profile = np.random.default_rng(6).uniform(50, 200, 60)
        image = np.broadcast_to(profile[:, None] if axis == 0 else profile, (60, 60))[None].astype(np.float32)
        made, _ = restore(image, sharpening())
        outer = made[0, [0, -1], 30] if axis == 0 else made[0, 30, [0, -1]]
        np.testing.assert_allclose(outer, profile[[0, -1]], rtol=1e-5)

    def test_a_step_beside_the_border_does_not_ring(self):
        """A blurred step, restored: beyond two pixels of it, at the border too, under 1 % of the step is left."""
        worst = 0.0
        for at in range(1, 12):
            step = np.where(np.arange(-20, 80) < at, 40.0, 200.0)
            blurred = ndimage.convolve1d(step, SPREAD)[20:]
            image = np.broadcast_to(blurred, (30, 80))[None].astype(np.float32)
            made, _ = restore(image, sharpening())
            error = np.abs(made[0, 15] - step[20:])
            near = np.abs(np.arange(80) - at + 0.5) < 2
            worst = max(worst, float(error[~near].max()) / 160)
        print(f"ringing of a restored step beside the border: {worst:.2%} of the step")
        assert worst < 0.02

    @pytest.mark.parametrize("size", [(1, 1), (2, 3), (4, 60), (9, 9)])
    def test_images_smaller_than_the_filter(self, size):
        image = scene("uint8", size=size)
        made, _ = restore(image, sharpening())
        assert made.shape == image.shape
        flat, _ = restore(np.full_like(image, 80), sharpening())
        assert (flat == 80).all()


class TestGaps:
    @pytest.mark.parametrize("shape", [None, (3, 3), (11, 11)])
    def test_nothing_of_invalid_pixels_leaks(self, shape):
        """Whatever value invalid pixels hold, NaN too, valid ones come out the same; invalid ones become 0.

        Small kernels are filled up with columns of zeros, which must not meet NaN either.
        """
        rng = np.random.default_rng(7)
        image = scene("float32", bands=1)
        valid = rng.random(image.shape[1:]) > 0.1
        valid[:, 30:44] = False
        used = RestorationFilter((FilterKernel(random_kernel(1, shape)),)) if shape else sharpening(1)
        made = []
        for poison in (0.0, 1e30, np.nan, np.inf):
            spoilt = image.copy()
            spoilt[:, ~valid] = poison
            made.append(restore(spoilt, used, valid)[0])
        assert np.isfinite(made[0]).all() and (made[0][:, ~valid] == 0).all()
        for other in made[1:]:
            assert other.tobytes() == made[0].tobytes()

    def test_fault_22_a_bright_image_with_a_hole_has_no_fringe(self):
        image = np.full((1, 60, 60), 180, np.uint8)
        valid = np.hypot(*(np.mgrid[:60, :60] - 30)) > 14
        image[:, ~valid] = 0
        made, _ = restore(image, sharpening(), valid)
        assert (made[0][valid] == 180).all()

    @pytest.mark.parametrize("valid_columns", [slice(10, 40), slice(0, 25)])
    def test_a_ramp_goes_on_across_a_straight_edge_of_the_valid_part(self, valid_columns):
        y, x = np.mgrid[:40, :50]
        ramp = (3.0 * x - 2.0 * y + 100)[None].astype(np.float32)
        valid = np.zeros((40, 50), bool)
        valid[:, valid_columns] = True
        made, _ = restore(ramp, sharpening(), valid)
        np.testing.assert_allclose(made[0][valid], ramp[0][valid], atol=2e-4)

    def test_a_dead_column_is_bridged(self):
        y, x = np.mgrid[:40, :50]
        ramp = (3.0 * x - 2.0 * y + 100)[None].astype(np.float32)
        valid = np.ones((40, 50), bool)
        valid[:, 22] = False
        made, _ = restore(ramp, sharpening(), valid)
        np.testing.assert_allclose(made[0][valid], ramp[0][valid], atol=2e-4)


class TestField:
    def test_between_places_of_a_grid_kernels_are_interpolated_bilinearly(self):
        """Pixel by pixel the same as with the kernel that is interpolated for it."""
        image = scene("float32", bands=1, size=(40, 30))
        xs, ys = (5.0, 20.0, 33.0), (3.0, 25.0)
        kernels = {(x, y): random_kernel(int(x + 100 * y), (3, 3)) for x in xs for y in ys}
        used = RestorationFilter(tuple(FilterKernel(v, at) for at, v in kernels.items()), (40, 30))
        made, _ = restore(image, used, side=13)
        table = np.array([[kernels[x, y] for x in xs] for y in ys])
        for row, col in [(10, 10), (3, 5), (27, 38), (1, 1), (15, 30), (25, 20)]:
            across = [np.interp(col, xs, unit) for unit in np.eye(3)]
            down = [np.interp(row, ys, unit) for unit in np.eye(2)]
            between = np.einsum("y,x,yxik->ik", down, across, table)
            alone, _ = restore(image, RestorationFilter((FilterKernel(between),)))
            np.testing.assert_allclose(made[0, row, col], alone[0, row, col], atol=1e-5)

    def test_each_scattered_place_has_its_own_filter(self):
        image = scene("float32", bands=1, size=(40, 30))
        places = [(4.0, 4.0), (30.0, 7.0), (17.0, 22.0)]
        kernels = [random_kernel(i, (3, 3)) for i in range(3)]
        used = RestorationFilter(tuple(FilterKernel(k, at) for k, at in zip(kernels, places)), (40, 30))
        made, _ = restore(image, used)
        for kernel, (col, row) in zip(kernels, places):
            alone, _ = restore(image, RestorationFilter((FilterKernel(kernel),)))
            np.testing.assert_allclose(made[0, int(row), int(col)], alone[0, int(row), int(col)], atol=1e-5)

    @pytest.mark.parametrize("count", [1, 2, 3, 4, 6])
    def test_weights_add_up_to_one_everywhere(self, count):
        places = [(5.0, 5.0), (50.0, 5.0), (5.0, 40.0), (50.0, 40.0), (27.0, 5.0), (27.0, 40.0)][:count]
        window = Window(-3, 2, 70, 60)
        found = field_weights(places, window)
        total = sum(np.ones((60, 70)) if weights is None else weights for _, weights in found)
        np.testing.assert_allclose(total, 1.0, atol=1e-6)

    def test_a_place_far_away_costs_nothing(self):
        places = [(float(x), float(y)) for x in (0, 1000, 2000) for y in (0, 1000, 2000)]
        assert [i for i, _ in field_weights(places, Window(10, 10, 100, 100))] == [0, 1, 3, 4]

    def test_an_image_of_another_size_is_refused(self):
        used = RestorationFilter((FilterKernel(random_kernel(1), (5.0, 5.0)),), (40, 30))
        with pytest.raises(InputError, match="places in images of 40 × 30 pixels, the image has 90 × 70"):
            restore(scene("uint8"), used)


class TestLight:
    def test_srgb_is_filtered_as_light_and_encoded_again(self):
        """A blurred edge of light, encoded, restored: the true edge comes back, which grey values would not give."""
        light = np.where(np.arange(80) < 40, 20.0, 220.0)
        blurred = ndimage.convolve1d(light, SPREAD)
        srgb = Linearisation("srgb")
        image = np.broadcast_to(np.rint(srgb.to_values(blurred * 256, np.uint16)), (20, 80))[None].astype(np.uint16)
        made, _ = restore(image, sharpening(), light=srgb)
        wanted = srgb.to_values(light * 256, np.uint16)
        right = np.abs(made[0, 10] - wanted)[10:-10].max() / 65535
        wrong = np.abs(restore(image, sharpening())[0][0, 10] - wanted)[10:-10].max() / 65535
        print(f"restored edge in sRGB: off by {right:.3%} of the range as light, {wrong:.3%} as grey values")
        assert right < 0.01 < wrong

    def test_a_table_ends_where_the_sensor_does(self):
        """Light beyond the table is clipped, and counted."""
        table = Linearisation.from_table(np.arange(256.0) ** 2)
        image = np.full((1, 20, 30), 100, np.uint8)
        image[0, 10, 10] = 250
        values = np.zeros((3, 3))
        values[1] = -1, 3, -1
        made, clipped = restore(image, RestorationFilter((FilterKernel(values),)), light=table)
        assert clipped.tolist() == [[2], [1]]
        assert made[0, 10, 8:13].tolist() == [100, 0, 255, 0, 100]

    def test_values_that_the_table_lacks(self):
        table = Linearisation.from_table(np.arange(200.0))
        image = np.full((1, 20, 30), 210, np.uint8)
        with pytest.raises(InputError, match="the linearisation table holds 0 to 199"):
            restore(image, sharpening(), light=table)
        valid = np.ones((20, 30), bool)
        image[:] = 150
        image[0, 3, 3], valid[3, 3] = 255, False
        assert (restore(image, sharpening(), valid, light=table)[0][0][valid] == 150).all()


class TestNoise:
    @pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32"])
    @pytest.mark.parametrize("shape", [(11, 11), (5, 7)])
    def test_noise_gain_is_the_root_of_the_sum_of_squares(self, dtype, shape):
        """Measured on a noise image within 2 %."""
        kernel = FilterKernel(np.outer(inverse(), inverse()) if shape == (11, 11) else random_kernel(3, shape))
        sigma = {"uint8": 8.0, "uint16": 500.0, "float32": 0.01}[dtype]
        middle = {"uint8": 110.0, "uint16": 30_000.0, "float32": 0.5}[dtype]
        noise = np.random.default_rng(8).normal(middle, sigma, (1, 512, 512))
        image = (np.rint(noise) if dtype != "float32" else noise).astype(dtype)
        made, clipped = restore(image, RestorationFilter((kernel,)))
        assert not clipped.any()
        inner = np.s_[0, 8:-8, 8:-8]
        measured = made[inner].astype(float).std() / image[inner].astype(float).std()
        print(f"noise gain of {dtype}, {shape}: {kernel.noise_gain:.4f} computed, {measured:.4f} measured")
        assert abs(measured / kernel.noise_gain - 1) < 0.02
