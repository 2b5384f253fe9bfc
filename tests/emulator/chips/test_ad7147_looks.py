"""Nothing that the chip does depends on how often somebody looks at it."""

import numpy as np
import pytest

from emulator.chips import ad7147_map as reg
from emulator.chips.ad7147 import AD7147
from tests.support.looks import one_run, put, words

SEQUENCE_S = 12 * 0.768e-3


@pytest.mark.parametrize(
    "seed",
    [*range(40), *(pytest.param(seed, marks=pytest.mark.long) for seed in range(40, 120))],
)
def test_registers_interrupts_and_conversions_are_the_same_however_one_looked(seed: int) -> None:
    one_run(seed)


def test_something_near_is_seen_without_a_look_before() -> None:
    chip = AD7147()
    chip.set_capacitances_ff(np.full(12, 10240.0))
    set_up_button(chip)
    chip.advance(SEQUENCE_S)
    chip.set_capacitance_ff(0, 10240.0 + 0.36 * 1200)
    chip.advance(SEQUENCE_S)
    assert words(chip, reg.PROXIMITY_STATUS, 1) == [1]


def test_proximity_recalibrates_however_often_the_chip_is_read() -> None:
    ambient = []
    for reads in (0, 4000):
        chip = AD7147()
        chip.set_capacitances_ff(np.full(12, 10240.0))
        set_up_button(chip)
        chip.advance(SEQUENCE_S)
        chip.set_capacitance_ff(0, 10240.0 + 0.36 * 1200)
        for _ in range(reads):
            chip.advance(2.0 / reads)
            words(chip, reg.CDC_RESULT, 1)
        if not reads:
            chip.advance(2.0)
        ambient.append(words(chip, reg.BANK_3 + reg.SF_AMBIENT, 1))
    assert ambient[0] == ambient[1] != [32768]


def test_calibration_of_all_stages_stops_while_something_is_near_one() -> None:
    chip = AD7147()
    chip.set_capacitances_ff(np.full(12, 10240.0))
    set_up_button(chip, recalibrate=0)
    chip.advance(SEQUENCE_S)
    chip.set_capacitance_ff(0, 10240.0 + 0.36 * 1200)
    chip.set_capacitance_ff(1, 10240.0 + 0.36 * 133)
    chip.advance(30.0)
    assert words(chip, reg.BANK_3 + reg.RESULT_WORDS + reg.SF_AMBIENT, 1) == [32768]


def test_forced_calibration_acts_on_each_write_with_its_bit_set() -> None:
    chip = AD7147()
    chip.set_capacitances_ff(np.full(12, 10240.0))
    set_up_button(chip, recalibrate=0)
    for codes in (1000, 2000):
        put(chip, reg.AMB_COMP_CTRL0, words(chip, reg.AMB_COMP_CTRL0, 1)[0] | reg.FORCED_CAL)
        chip.set_capacitance_ff(0, 10240.0 + 0.36 * codes)
        chip.advance(SEQUENCE_S)
        assert words(chip, reg.BANK_3 + reg.SF_AMBIENT, 1) == [32768 + codes]


def test_without_excitation_every_stage_reads_the_middle_of_the_scale() -> None:
    chip = AD7147()
    chip.set_capacitances_ff(np.full(12, 12345.0))
    set_up_button(chip)
    put(chip, reg.PWR_CONTROL, 0x02B0 | reg.EXT_SOURCE)
    chip.advance(SEQUENCE_S)
    assert words(chip, reg.CDC_RESULT, 12) == [32768] * 12


def set_up_button(chip: AD7147, recalibrate: int = 0x0832) -> None:
    """Twelve buttons, one input each, thresholds around an ambient that is followed."""
    for stage in range(12):
        low = 0xFFFF & ~(1 << 2 * stage) if stage < 7 else 0xFFFF
        high = 0x1FFF & ~(1 << 2 * (stage - 7)) if stage >= 7 else 0x1FFF
        put(chip, 0x080 + 8 * stage, low, high, 0x2000, 0x2626, 1600, 1600, 1600, 1600)
    put(chip, 0x000, 0x02B0, 0, 0x3233, 0x0819, recalibrate, 0, 0x0FFF, 0)
    put(chip, 0x001, 0x0FFF)
