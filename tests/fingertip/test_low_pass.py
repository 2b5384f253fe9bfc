import numpy as np
import pytest

from skin_host.fingertip.low_pass import Butterworth2


def gain(filter_hz, tone_hz, rate_hz):
    low_pass = Butterworth2(filter_hz, rate_hz)
    t = np.arange(int(20 * rate_hz / tone_hz)) / rate_hz
    out = np.array([low_pass.step(np.sin(2 * np.pi * tone_hz * now))[0] for now in t])
    tail = out[len(out) // 2 :]
    return np.sqrt(2.0) * tail.std()


def test_the_filter_is_a_two_pole_butterworth_at_10_of_300_hz():
    assert gain(10.0, 10.0, 300.0) == pytest.approx(np.sqrt(0.5), rel=0.01)
    assert gain(10.0, 1.0, 300.0) == pytest.approx(1.0, abs=0.001)
    assert gain(10.0, 40.0, 300.0) == pytest.approx(1 / 16, rel=0.15)  # 12 dB an octave


def test_the_filter_starts_at_rest_on_its_first_sample_and_survives_a_nan():
    low_pass = Butterworth2(10.0, 300.0, channels=2)
    assert np.isnan(low_pass.step([np.nan, 1.0])).any()
    np.testing.assert_allclose(low_pass.step([3.0, -1.0]), [3.0, -1.0])
    np.testing.assert_allclose(low_pass.step([3.0, -1.0]), [3.0, -1.0])
    low_pass.step([np.nan, -1.0])
    np.testing.assert_allclose(low_pass.step([3.0, -1.0]), [3.0, -1.0])


def test_a_corner_beyond_half_the_rate_is_refused():
    with pytest.raises(ValueError, match="cutoff 200"):
        Butterworth2(200.0, 300.0)
