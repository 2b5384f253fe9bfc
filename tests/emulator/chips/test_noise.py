"""Pads are as noisy as those of the recordings, and every conversion is one measurement."""

import numpy as np
import pytest
from numpy.typing import NDArray

from emulator.chips.noise import TAXELS, ChipNoise, PadNoise, SampledNoise

Floats = NDArray[np.float64]
SWEEP_NS = 20_437_000
TRIANGLES = 400
#: Of triangles of ten pads; the other two are thermal.
PADS = [0, 1, 2, 3, 4, 5, 7, 8, 9, 11]
NO_THERMAL = np.zeros((20, TAXELS), bool)


def five_seconds(noise: SampledNoise, sweep_ns: int = SWEEP_NS) -> Floats:
    """What a host receives in 5 s: whole units [sweeps, n]."""
    return np.rint([noise.at(t_ns) for t_ns in range(0, 5_000_000_000, sweep_ns)])


@pytest.fixture(scope="module")
def received() -> Floats:
    return five_seconds(SampledNoise(TRIANGLES, seed=4))


def test_pads_differ_as_the_recorded_ones_do(received: Floats) -> None:
    """Standard deviations at 5, 25, 50, 75 and 95 % of the pads of `left_calibration`."""
    pads = received.reshape(len(received), TRIANGLES, TAXELS)[:, :, PADS]
    found = np.percentile(pads.std(axis=0), [5, 25, 50, 75, 95])

    assert found == pytest.approx([0.69, 0.82, 1.04, 1.41, 5.3], rel=0.1)


def test_one_pad_in_twenty_jumps_between_levels(received: Floats) -> None:
    centred = received - received.mean(axis=0)
    deviation = centred.std(axis=0)
    jumping = centred[:, deviation > 4.5]
    kurtosis = np.mean(jumping**4, axis=0) / np.mean(jumping**2, axis=0) ** 2
    apart = np.ptp(np.percentile(jumping, [20, 80], axis=0), axis=0)

    assert np.mean(deviation > 4.5) == pytest.approx(0.06, abs=0.02)
    assert np.median(kurtosis) < 1.8
    assert np.all((apart > 8) & (apart < 16))


def test_pads_of_a_triangle_share_noise_and_triangles_share_none(received: Floats) -> None:
    centred = (received - received.mean(axis=0)).reshape(len(received), TRIANGLES, TAXELS)
    of_triangle = centred[:, :, PADS].mean(axis=2)

    assert np.median(of_triangle.std(axis=0)) == pytest.approx(0.57, rel=0.1)
    assert of_triangle.mean(axis=1).std() < 0.05


@pytest.mark.parametrize("hz", [25, 50, 100])
def test_a_conversion_is_sent_until_the_next_one_has_ended(hz: int) -> None:
    noise = SampledNoise(TRIANGLES, seed=1)
    level = np.array([noise.at(round(k * 1e9 / hz)) for k in range(5 * hz)])
    changes = np.mean(np.diff(level, axis=0) != 0)

    assert changes == pytest.approx(min(1.0, 1 / (hz * 0.036864)), rel=0.02)


def test_the_same_seed_draws_the_same_noise() -> None:
    one, same, other = (five_seconds(SampledNoise(3, seed)) for seed in (5, 5, 6))

    assert np.array_equal(one, same)
    assert not np.array_equal(one, other)


def test_fingertips_pick_up_nothing_periodic() -> None:
    others = PadNoise.drawn(NO_THERMAL, np.random.default_rng(2))
    calm = others.wave.any(axis=1) & (np.arange(20) % 2 == 0)
    assert calm.any()
    pads = PadNoise.drawn(NO_THERMAL, np.random.default_rng(2), calm)
    assert not pads.wave[calm].any()
    assert pads.rms_units[calm].max() < 2.0
    assert np.array_equal(pads.rms_units[~calm], others.rms_units[~calm])


def test_every_pad_has_the_rms_that_was_drawn_for_it() -> None:
    pads = PadNoise.drawn(NO_THERMAL, np.random.default_rng(2))
    drawn = pads.variates((20_000,), np.random.default_rng(3))

    assert np.sqrt(np.mean(drawn**2, axis=0)) == pytest.approx(np.ones((20, 12)), abs=0.03)


def test_a_conversion_has_the_same_noise_whoever_asks_and_how_often() -> None:
    pads = PadNoise.drawn(NO_THERMAL, np.random.default_rng(2))
    skin = ChipNoise(np.arange(20) + 77, pads)
    began_ns = np.random.default_rng(3).integers(1 << 50, size=(20, TAXELS))

    together = skin.at(np.arange(20), began_ns)

    for chip in range(20):
        alone = skin.one(chip).at(np.zeros(1, np.intp), began_ns[chip : chip + 1])
        assert np.array_equal(alone[0], together[chip])


def test_conversions_of_a_pad_have_unit_variance_and_nothing_in_common() -> None:
    pads = PadNoise.drawn(NO_THERMAL, np.random.default_rng(2))
    skin = ChipNoise(np.arange(20), pads)
    passes = 36_864_000 * np.arange(20_000)
    drawn = np.array([skin.at(np.arange(20), np.full((20, TAXELS), at)) for at in passes])

    assert np.std(drawn, axis=0) == pytest.approx(np.ones((20, 12)), abs=0.03)
    after = np.mean(drawn[1:] * drawn[:-1], axis=0)
    assert np.abs(after).max() < 0.04
    beside = np.mean(drawn[:, :, :-1] * drawn[:, :, 1:], axis=0)
    assert np.abs(beside).max() < 0.04
