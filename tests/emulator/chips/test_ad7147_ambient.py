"""Thresholds, status, interrupt and slow calibration, as the Linux ad714x driver needs them."""

import numpy as np
import pytest

from emulator.chips.ad7147 import AD7147

SEQUENCE_S = 9.216e-3
HIGH, COMPLETE = 0x009, 0x00A
SF_AMBIENT, HIGH_THRESHOLD, LOW_THRESHOLD = 0x0F1, 0x0FA, 0x101
REST_FF = 10240.0
#: The high threshold of stage 0 lies 0.53 x 1600 codes above ambient.
TOUCH_FF = 0.36 * 1200


def put(chip, address, *words):
    chip.write(b"".join(w.to_bytes(2, "big") for w in (address, *words)))


def get(chip, address, n=1):
    chip.write(address.to_bytes(2, "big"))
    data = chip.read(2 * n)
    values = [int.from_bytes(data[i : i + 2], "big") for i in range(0, 2 * n, 2)]
    return values if n > 1 else values[0]


def button_chip(power=0x02B0, low_enable=0, high_enable=0x0FFF, complete_enable=0, level=0x0819):
    """Twelve buttons, one input each, that a press raises."""
    chip = AD7147()
    chip.set_capacitances_ff(np.full(12, REST_FF))
    for stage in range(12):
        low = 0xFFFF & ~(1 << 2 * stage) if stage < 7 else 0xFFFF
        high = 0x1FFF & ~(1 << 2 * (stage - 7)) if stage >= 7 else 0x1FFF
        put(chip, 0x080 + 8 * stage, low, high, 0x2000, 0x2626, 1600, 1600, 1600, 1600)
    words = (power, 0, 0x3233, level, 0x0832, low_enable, high_enable, complete_enable)
    put(chip, 0x000, *words)
    put(chip, 0x001, 0x0FFF)
    get(chip, 0x008, 3)
    return chip


def press(chip, stage=0, by_ff=TOUCH_FF):
    chip.set_capacitance_ff(stage, REST_FF + by_ff)


class TestThresholds:
    def test_they_lie_a_quarter_and_a_share_of_the_offset_around_ambient(self):
        chip = button_chip()
        chip.advance(SEQUENCE_S)
        ambient = get(chip, SF_AMBIENT)
        assert ambient == 32768
        expected = 1600 / 4 + 0.75 * 1600 / 16 * 6
        assert get(chip, HIGH_THRESHOLD) == ambient + expected
        assert get(chip, LOW_THRESHOLD) == ambient - expected

    def test_without_calibration_the_written_thresholds_rule(self):
        chip = button_chip()
        put(chip, 0x001, 0)
        put(chip, HIGH_THRESHOLD, 32768 + 10)
        press(chip, by_ff=0.36 * 11)
        chip.advance(SEQUENCE_S)
        assert get(chip, HIGH) & 1


class TestStatus:
    def test_a_touched_stage_shows_its_bit_again_after_each_conversion(self):
        chip = button_chip()
        chip.advance(SEQUENCE_S)
        press(chip, 3)
        for _ in range(3):
            chip.advance(SEQUENCE_S)
            assert get(chip, HIGH) == 1 << 3
            assert get(chip, HIGH) == 0

    def test_bits_show_whether_their_interrupt_is_enabled_or_not(self):
        chip = button_chip(high_enable=0)
        chip.advance(SEQUENCE_S)
        press(chip, 2)
        chip.advance(SEQUENCE_S)
        assert get(chip, HIGH) == 1 << 2
        assert not chip.interrupt

    def test_every_converted_stage_is_complete_enabled_or_not(self):
        chip = button_chip(complete_enable=1 << 11)
        get(chip, 0x008, 3)
        chip.advance(4 * 0.768e-3)
        assert get(chip, COMPLETE) == 0x00F

    def test_a_low_threshold_works_the_other_way(self):
        chip = button_chip(low_enable=0x0FFF)
        chip.advance(SEQUENCE_S)
        press(chip, 1, -TOUCH_FF)
        chip.advance(SEQUENCE_S)
        assert get(chip, 0x008, 2) == [1 << 1, 0]


class TestInterrupt:
    def test_threshold_mode_tells_touch_and_lift_off_once_each(self):
        chip = button_chip()
        chip.advance(SEQUENCE_S)
        assert not chip.interrupt
        press(chip)
        chip.advance(SEQUENCE_S)
        assert chip.interrupt
        assert get(chip, 0x008, 3)[1] == 1
        chip.advance(SEQUENCE_S)
        assert not chip.interrupt
        chip.set_capacitance_ff(0, REST_FF)
        chip.advance(SEQUENCE_S)
        assert chip.interrupt
        assert get(chip, 0x008, 3)[1] == 0

    def test_complete_mode_asserts_every_sequence(self):
        chip = button_chip(high_enable=0, complete_enable=1 << 11)
        for _ in range(3):
            chip.advance(SEQUENCE_S)
            assert chip.interrupt
            get(chip, 0x008, 3)
            assert not chip.interrupt

    @pytest.mark.parametrize(("polarity", "asserted", "idle"), [(0, 0, 1), (0x0800, 1, 0)])
    def test_the_pin_is_active_low_unless_told_otherwise(self, polarity, asserted, idle):
        chip = button_chip(power=0x02B0 | polarity, complete_enable=1 << 11)
        get(chip, 0x008, 3)
        assert chip.int_level == idle
        chip.advance(SEQUENCE_S)
        assert chip.int_level == asserted


class TestSlowCalibration:
    def test_ambient_follows_slow_drift_and_results_do_not(self):
        chip = button_chip(level=0x08FF)
        chip.advance(SEQUENCE_S)
        for k in range(100):
            press(chip, 0, 0.36 * k)
            chip.advance(10 * SEQUENCE_S)
        assert get(chip, SF_AMBIENT) == pytest.approx(32768 + 96, abs=4)
        assert get(chip, 0x00B) == 32768 + 99

    def test_it_freezes_while_something_is_near(self):
        chip = button_chip()
        chip.advance(SEQUENCE_S)
        press(chip, 0, 0.36 * 500)
        chip.advance(20 * SEQUENCE_S)
        assert get(chip, 0x042) == 1
        assert get(chip, SF_AMBIENT) == 32768

    def test_something_that_stays_becomes_the_new_ambient(self):
        chip = button_chip()
        chip.advance(SEQUENCE_S)
        press(chip)
        chip.advance(60 * SEQUENCE_S)
        assert get(chip, SF_AMBIENT) == 32768 + 1200
        assert get(chip, HIGH) == 0

    def test_forced_calibration_takes_the_present_as_ambient(self):
        chip = button_chip()
        chip.advance(SEQUENCE_S)
        press(chip)
        chip.advance(SEQUENCE_S)
        put(chip, 0x002, 0x3233 | 0x4000)
        chip.advance(SEQUENCE_S)
        assert get(chip, SF_AMBIENT) == 32768 + 1200

    def test_strong_presses_move_the_offset_that_was_written(self):
        chip = button_chip()
        put(chip, 0x086, 2000)
        chip.advance(SEQUENCE_S)
        press(chip, 0, 0.36 * 1900)
        chip.advance(5 * SEQUENCE_S)
        assert 1600 < get(chip, 0x085) <= 1900

    def test_with_a_proximity_level_of_zero_ambient_stays_at_its_first_value(self):
        chip = button_chip(high_enable=0, level=0)
        put(chip, 0x004, 0)
        chip.advance(SEQUENCE_S)
        assert get(chip, SF_AMBIENT) == 32768
        for k in range(50):
            press(chip, 0, 0.36 * k)
            chip.advance(0.05)
        assert get(chip, SF_AMBIENT) == 32768

    @pytest.mark.parametrize("parts", [1, 7, 100])
    def test_an_interval_counts_the_same_in_one_piece_or_in_many(self, parts):
        chip = button_chip(level=0x08FF)
        chip.advance(SEQUENCE_S)
        press(chip, 0, 0.36 * 300)
        for _ in range(parts):
            chip.advance(21 * SEQUENCE_S / parts)
            assert chip.int_level in (0, 1)
        whole = button_chip(level=0x08FF)
        whole.advance(SEQUENCE_S)
        press(whole, 0, 0.36 * 300)
        whole.advance(21 * SEQUENCE_S + 1e-6)
        chip.advance(1e-6)
        assert get(chip, SF_AMBIENT) == get(whole, SF_AMBIENT)


class TestLowPower:
    def test_a_touch_wakes_the_chip_and_it_sleeps_again_afterwards(self):
        chip = button_chip(power=0x02B2)
        chip.advance(1.0)
        press(chip)
        chip.advance(0.21)
        assert get(chip, HIGH) == 1
        # Awake: a conversion every 9 ms.
        chip.advance(0.01)
        assert get(chip, HIGH) == 1
        chip.set_capacitance_ff(0, REST_FF)
        chip.advance(0.01)
        assert get(chip, HIGH) == 0
        # 2 x 3 x 16 sequences later it sleeps 200 ms between sequences again.
        chip.advance(2.0)
        complete = 0
        for _ in range(100):
            get(chip, COMPLETE)
            chip.advance(0.01)
            complete += get(chip, COMPLETE) >> 11 & 1
        assert 3 <= complete <= 6

    def test_an_untouched_chip_converts_five_times_a_second(self):
        chip = button_chip(power=0x02B2)
        complete = 0
        for _ in range(1000):
            chip.advance(0.01)
            complete += get(chip, COMPLETE) >> 11 & 1
        assert complete == pytest.approx(10 / 0.209216, abs=1)


class TestOpen:
    """What the model does where no source at hand decides, see docs/scenes.md."""

    def joystick(self):
        """Stages 8 to 10 of the board data in Linux: two differences, and the sum."""
        chip = AD7147()
        chip.set_capacitances_ff(np.full(13, 3000.0))
        for stage, words in (
            (8, (0xFF7B, 0x3FFF, 0x0506, 0x2626, 1100, 1100, 1150, 1150)),
            (9, (0xFDFE, 0x3FFF, 0x0606, 0x2626, 1100, 1100, 1150, 1150)),
            (10, (0xFEBA, 0x1FFF, 0x1400, 0x2626, 1200, 1200, 1300, 1300)),
        ):
            put(chip, 0x080 + 8 * stage, *words)
        put(chip, 0x000, 0x02B0, 0, 0x3233, 0x0819, 0x0832, 0x0700, 0x0700, 0)
        put(chip, 0x001, 0x0700)
        chip.advance(1.0)
        return chip

    def test_opposite_keys_of_one_stage_release_each_other(self):
        chip = self.joystick()
        chip.set_capacitance_ff(0, 3500.0)
        chip.advance(2 * SEQUENCE_S)
        assert get(chip, 0x041) & 0x700 == 0x600
        chip.set_capacitance_ff(4, 3500.0)
        chip.advance(2 * SEQUENCE_S)
        assert get(chip, 0x041) & 0x700 == 0x400

    def test_opposite_keys_within_one_sequence_are_the_sum_alone(self):
        chip = self.joystick()
        chip.set_capacitance_ff(0, 3500.0)
        chip.set_capacitance_ff(4, 3500.0)
        chip.advance(2 * SEQUENCE_S)
        assert get(chip, 0x041) & 0x700 == 0x400

    def test_a_key_that_is_held_becomes_the_ambient_value(self):
        chip = self.joystick()
        chip.set_capacitance_ff(0, 3500.0)
        chip.advance(49 * SEQUENCE_S)
        assert get(chip, 0x041) & 0x700 == 0x600
        chip.advance(4 * SEQUENCE_S)
        assert get(chip, 0x041) & 0x700 == 0
