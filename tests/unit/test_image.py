"""Tone curves and files of radiance."""

from __future__ import annotations

import numpy as np
import pytest

from workbench.errors import InputError, OptionError
from workbench.render.image import TONE_CURVES, Exposure, srgb_bytes, tone_mapped, write_radiance


@pytest.fixture
def ramp():
    return np.geomspace(1e-3, 10.0, 300).reshape(10, 10, 3)


@pytest.mark.parametrize("curve", TONE_CURVES)
def test_curves_rise_from_black_to_white_and_more_exposure_is_brighter(ramp, curve):
    plain = tone_mapped(ramp, curve, Exposure(ramp))
    assert plain.min() >= 0 and plain.max() <= 1
    grey = np.repeat(np.sort(ramp.ravel())[:, None], 3, axis=1)[None]
    steps = tone_mapped(grey, curve, Exposure(ramp))[0, :, 0]
    assert (np.diff(steps) >= -1e-12).all() and steps[-1] > 0.8
    assert tone_mapped(ramp, curve, Exposure(ramp, stops=1.0)).mean() > plain.mean()
    assert (tone_mapped(np.zeros((2, 2, 3)), curve, Exposure(np.zeros((2, 2, 3)))) == 0).all()


def test_linear_is_proportional_and_reinhard_puts_grey_where_its_formula_says(ramp):
    linear = tone_mapped(ramp, "linear", Exposure(ramp, white=2.0))
    np.testing.assert_allclose(linear, np.minimum(ramp / 2.0, 1.0))
    flat = np.full((4, 4, 3), 3.0)
    # Log-average at the key 0.18, burnt out there too: L (1 + L / Lw^2) / (1 + L) with L = Lw = 0.18 is 1.
    np.testing.assert_allclose(tone_mapped(flat, "reinhard", Exposure(flat)), 1.0)
    flat[0, 0] = 300.0
    exposure = Exposure(flat)
    light = 3.0 * 0.18 / exposure.average
    expected = light * (1 + light / (exposure.burnt * 0.18 / exposure.average) ** 2) / (1 + light)
    np.testing.assert_allclose(tone_mapped(flat, "reinhard", exposure)[1, 1], expected, rtol=1e-9)


def test_srgb_bytes_follow_the_standard():
    light = np.array([0.0, 0.0031308, 0.18, 0.5, 1.0, 2.0]).reshape(1, 2, 3)
    # IEC 61966-2-1: 12.92 x below 0.0031308, 1.055 x^(1/2.4) - 0.055 above
    assert srgb_bytes(light).ravel().tolist() == [0, 10, 118, 188, 255, 255]


def test_radiance_comes_back_from_both_formats(tmp_path, ramp):
    import OpenEXR

    write_radiance(tmp_path / "a.exr", ramp)
    np.testing.assert_array_equal(
        OpenEXR.File(str(tmp_path / "a.exr")).channels()["RGB"].pixels, ramp.astype(np.float32)
    )
    ramp[0, 0] = 0.0
    write_radiance(tmp_path / "a.hdr", ramp)
    data = (tmp_path / "a.hdr").read_bytes().split(b"+X 10\n", 1)[1]
    pixels = np.frombuffer(data, np.uint8).reshape(10, 10, 4).astype(float)
    back = pixels[..., :3] * np.exp2(pixels[..., 3:] - 136)
    # Eight bits beside the largest band.
    assert (np.abs(back - ramp) <= ramp.max(axis=2, keepdims=True) / 128 + 1e-12).all()
    with pytest.raises(InputError, match="shape"):
        write_radiance(tmp_path / "b.exr", ramp[..., :2])
    with pytest.raises(OptionError, match="jpg"):
        write_radiance(tmp_path / "b.jpg", ramp)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.exr", "a.hdr"]


@pytest.mark.parametrize(("stops", "white"), [(np.nan, None), (0.0, 0.0), (0.0, np.inf)])
def test_exposures_out_of_range_are_refused(ramp, stops, white):
    with pytest.raises(OptionError):
        Exposure(ramp, stops, white)
