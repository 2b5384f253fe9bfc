import importlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from emulator.chips.ad7147 import AD7147
from emulator.chips.i2c import EmulatedSMBus

RESULTS = 0x00B
STATUS = 0x008


def word(value):
    return value.to_bytes(2, "big")


def put(chip, address, *words):
    data = word(address) + b"".join(map(word, words))
    return chip.write(data) == len(data)


def get(chip, address, n=1):
    chip.write(word(address))
    data = chip.read(2 * n)
    values = [int.from_bytes(data[i : i + 2], "big") for i in range(0, 2 * n, 2)]
    return values if n > 1 else values[0]


def connections(positive=(), negative=(), setup=1):
    """Connection words of a stage, every other input on BIAS."""
    codes = [2 if i in positive else 1 if i in negative else 3 for i in range(13)]
    low = sum(code << 2 * i for i, code in enumerate(codes[:7]))
    high = sum(code << 2 * i for i, code in enumerate(codes[7:]))
    return low | 0xC000, high | setup << 12


def configure(chip, afe=0x2200, power=0x00B0):
    """The order of an iCub board: stages, Bank 1 in a burst, calibration on."""
    for stage in range(12):
        words = (*connections([stage]), afe, 0x2626, 50, 50, 100, 100)
        put(chip, 0x080 + 8 * stage, *words)
    put(chip, 0x000, power, 0x1EFF, 0, 0, 0, 0, 0, 0x0400, 0, 0, 0x0FFF)
    put(chip, 0x001, 0x0FFF)


def skin_chip(capacitance_ff=7800.0, power=0x00B0, **arguments):
    chip = AD7147(**arguments)
    configure(chip, power=power)
    chip.set_capacitances_ff(np.full(12, capacitance_ff))
    return chip


class TestRegisters:
    def test_reset_values_as_read_on_silicon(self):
        chip = AD7147()
        assert get(chip, 0x017) == 0x1471
        assert get(chip, 0x002, 3) == [0x0FF0, 0x0164, 0xFFFF]
        assert get(chip, 0x000) == get(chip, 0x001) == 0

    def test_ram_is_undefined_at_power_up_and_the_same_for_the_same_seed(self):
        def ram(seed):
            return get(AD7147(np.random.default_rng(seed)), 0x080, 96)

        assert len(set(ram(1))) > 80
        assert ram(1) == ram(1) != ram(2)

    def test_bank_2_keeps_all_sixteen_bits(self):
        chip = AD7147()
        put(chip, 0x080, 0xFFFE, 0x1FFF, 0xFFFF, 0xFFFF)
        assert get(chip, 0x080, 4) == [0xFFFE, 0x1FFF, 0xFFFF, 0xFFFF]

    def test_reserved_bits_read_zero(self):
        chip = AD7147()
        put(chip, 0x000, 0xFFFF & ~0x0400)
        put(chip, 0x006, 0xFFFF, 0xFFFF)
        assert get(chip, 0x000) == 0xDBFF
        assert get(chip, 0x006, 2) == [0x0FFF, 0x1FFF]

    def test_read_only_and_absent_registers_are_acknowledged_and_kept(self):
        chip = AD7147()
        for address in (0x008, 0x00B, 0x017, 0x018, 0x042, 0x07F, 0x103, 0x28F):
            before = get(chip, address)
            assert put(chip, address, 0x5A5A)
            assert get(chip, address) == before

    def test_unused_words_of_bank_3_are_holes_and_the_rest_is_ram(self):
        chip = AD7147()
        put(chip, 0x0E0 + 0x01, 0x1234)
        assert get(chip, 0x0E1) == 0x1234

    def test_bursts_run_on_word_by_word(self):
        chip = AD7147()
        put(chip, 0x080, *range(1, 97))
        assert get(chip, 0x080, 96) == list(range(1, 97))

    def test_the_upper_six_address_bits_are_ignored(self):
        assert get(AD7147(), 0xFC17) == 0x1471

    def test_the_pointer_survives_a_stop_and_moves_on_by_words(self):
        chip = AD7147()
        chip.write(word(0x002))
        assert chip.read(2) == word(0x0FF0)
        assert chip.read(4) == word(0x0164) + word(0xFFFF)

    def test_an_odd_read_gives_the_high_byte_and_stays(self):
        chip = AD7147()
        chip.write(word(0x017))
        assert chip.read(1) == b"\x14"
        assert chip.read(3) == b"\x14\x71\x00"

    def test_half_a_word_and_half_an_address_change_nothing(self):
        chip = AD7147()
        chip.write(word(0x003))
        assert chip.write(b"\x00") == 1
        assert chip.write(word(0x001) + b"\x12") == 3
        assert get(chip, 0x001) == 0

    def test_nothing_wraps_at_the_end_of_the_map(self):
        chip = AD7147()
        put(chip, 0x28E, 1, 2, 3, 4)
        assert get(chip, 0x000) == 0
        assert get(chip, 0x28E, 4) == [1, 0, 0, 0]
        assert chip.read(2) == b"\0\0"

    def test_software_reset_restores_defaults_without_its_last_acknowledge(self):
        chip = skin_chip()
        assert chip.write(word(0x000) + word(0x0400)) == 3
        assert get(chip, 0x000, 5) == [0, 0, 0x0FF0, 0x0164, 0xFFFF]

    def test_self_clearing_bits_read_zero(self):
        chip = AD7147()
        put(chip, 0x002, 0x8FF0)
        assert get(chip, 0x002) == 0x0FF0

    @given(st.binary(max_size=40), st.integers(0, 64))
    def test_no_message_breaks_it(self, data, length):
        chip = AD7147()
        chip.write(data)
        chip.advance(0.1)
        assert len(chip.read(length)) == length


class TestConversion:
    def test_mid_scale_is_the_offset_and_a_code_is_q(self):
        for q_ff in (0.36, 0.32, 0.244):
            chip = skin_chip(10880.0, q_ff=q_ff)
            chip.set_capacitance_ff(3, 10880.0 + 100 * q_ff)
            chip.advance(0.05)
            codes = get(chip, RESULTS, 12)
            assert codes[3] == 32768 + 100
            assert codes[2] == 32768

    def test_it_clips_and_does_not_wrap(self):
        chip = skin_chip(60000.0)
        chip.set_capacitance_ff(0, -60000.0)
        chip.advance(0.05)
        assert get(chip, RESULTS, 2) == [0, 65535]

    @pytest.mark.parametrize(
        ("disable", "afe", "steps"),
        [
            (0, 34 << 8, -34),
            (0, 34, +34),
            (0, 0x8000 | 34 << 8, +34),
            (0, 0x0080 | 34, -34),
            (0, 63 << 8 | 0x0080 | 63, -126),
            (0x8000, 34 << 8, 0),
            (0x4000, 34, 0),
        ],
    )
    def test_offset_dacs_work_on_either_side_or_not_at_all(self, disable, afe, steps):
        chip = AD7147()
        low, high = connections([0])
        put(chip, 0x080, low, high | disable, afe)
        chip.advance(0.01)
        code = get(chip, RESULTS)
        assert code == np.clip(32768 + round(steps * 320 / 0.36), 0, 65535)

    def test_inputs_on_one_side_add_and_the_other_side_counts_down(self):
        chip = AD7147()
        put(chip, 0x080, *connections([0, 5, 12], [6, 7], setup=3), 0)
        for cin, value in {0: 36.0, 5: 72.0, 12: 36.0, 6: 18.0, 7: 18.0, 8: 999.0}.items():
            chip.set_capacitance_ff(cin, value)
        chip.advance(0.01)
        assert get(chip, RESULTS) == 32768 + 300

    def test_all_twelve_pads_in_one_stage_are_read_hundreds_of_times_a_second(self):
        chip = AD7147()
        put(chip, 0x080, *connections(range(12)), 0)
        put(chip, 0x000, 0x0100)
        for cin in range(12):
            chip.set_capacitance_ff(cin, 36.0)
        chip.advance(0.0016)
        assert get(chip, RESULTS) == 32768 + 1200

    def test_an_input_on_bias_or_floating_does_not_count(self):
        chip = AD7147()
        put(chip, 0x080, 0x0002, 0x1000)
        chip.set_capacitances_ff([36.0, 500.0, 500.0])
        chip.advance(0.01)
        assert get(chip, RESULTS) == 32768 + 100

    def test_bank_3_mirrors_the_results(self):
        chip = skin_chip()
        chip.advance(0.05)
        results = get(chip, RESULTS, 12)
        assert [get(chip, 0x0E0 + 0x24 * stage) for stage in range(12)] == results

    def test_there_is_no_such_input(self):
        with pytest.raises(IndexError, match="inputs 0"):
            AD7147().set_capacitance_ff(13, 1.0)

    def test_time_does_not_run_backwards(self):
        with pytest.raises(ValueError, match="backwards"):
            AD7147().advance(-0.1)


class TestSequencer:
    @pytest.mark.parametrize(
        ("decimation", "sequence_s"), [(0, 36.864e-3), (1, 18.432e-3), (2, 9.216e-3), (3, 9.216e-3)]
    )
    def test_twelve_stages_take_the_time_of_table_10(self, decimation, sequence_s):
        chip = skin_chip(power=0x00B0 | decimation << 8)
        chip.advance(sequence_s - 1e-6)
        assert get(chip, RESULTS + 11) == 0
        chip.advance(1e-6)
        assert get(chip, RESULTS + 11) > 0

    def test_results_are_not_latched_as_a_set(self):
        chip = skin_chip()
        chip.advance(0.036864)
        chip.set_capacitances_ff(np.full(12, 7800.0 + 36.0))
        chip.advance(5 * 3.072e-3)
        codes = np.array(get(chip, RESULTS, 12))
        assert (codes[:5] == codes[11] + 100).all()
        assert (codes[5:] == codes[11]).all()

    def test_a_conversion_read_twice_is_the_same(self):
        chip = skin_chip(rng=np.random.default_rng(1))
        chip.advance(0.05)
        first = get(chip, RESULTS, 12)
        chip.advance(0.0001)
        assert get(chip, RESULTS, 12) == first

    def test_a_baseline_right_after_a_new_offset_is_the_old_one(self):
        chip = skin_chip()
        chip.advance(0.05)
        before = get(chip, RESULTS, 12)
        configure(chip, afe=0x2000)
        assert get(chip, RESULTS, 12) == before
        chip.advance(0.037)
        assert get(chip, RESULTS) == before[0] + round(640 / 0.36)

    def test_conversion_reset_starts_again_at_stage_0(self):
        chip = skin_chip()
        chip.advance(0.036864 + 6 * 3.072e-3)
        chip.set_capacitances_ff(np.full(12, 8000.0))
        put(chip, 0x002, 0x8000)
        chip.advance(3.072e-3)
        codes = get(chip, RESULTS, 12)
        assert codes[0] > codes[1] == codes[11]

    @pytest.mark.parametrize("mode", [1, 3])
    def test_shutdown_stops_conversions_and_keeps_the_set_up(self, mode):
        chip = skin_chip()
        chip.advance(0.05)
        set_up = get(chip, 0x080, 96)
        before = get(chip, RESULTS, 12)
        put(chip, 0x000, 0x00B0 | mode)
        chip.set_capacitances_ff(np.full(12, 8000.0))
        chip.advance(10.0)
        assert get(chip, RESULTS, 12) == before
        assert get(chip, 0x080, 96) == set_up
        put(chip, 0x000, 0x00B0)
        chip.advance(0.037)
        assert get(chip, RESULTS) > before[0]

    @pytest.mark.parametrize(("field", "delay_s"), [(0, 0.2), (1, 0.4), (2, 0.6), (3, 0.8)])
    def test_low_power_sleeps_between_sequences(self, field, delay_s):
        chip = skin_chip(power=0x02B2 | field << 2)
        chip.advance(9.216e-3)
        before = get(chip, RESULTS)
        chip.set_capacitances_ff(np.full(12, 8000.0))
        chip.advance(delay_s)
        assert get(chip, RESULTS) == before
        chip.advance(0.768e-3)
        assert get(chip, RESULTS) > before

    def test_a_month_without_a_read_is_one_step(self):
        chip = skin_chip()
        chip.advance(30 * 86400.0)
        assert get(chip, RESULTS) == round(32768 - 3080 / 0.36)

    @given(st.lists(st.floats(0, 0.2), min_size=1, max_size=20))
    def test_only_the_sum_of_the_steps_matters(self, steps):
        def run(parts):
            chip = skin_chip(rng=np.random.default_rng(4))
            for part in parts:
                chip.advance(part * 1e-9)
            return get(chip, RESULTS, 12) + get(chip, STATUS, 3)

        whole = [round(step * 1e9) for step in steps]
        assert run(whole) == run([sum(whole)])


class TestNoise:
    @pytest.mark.parametrize(("decimation", "rms"), [(0, 0.5), (1, 0.8), (2, 1.1)])
    def test_it_grows_as_decimation_falls(self, decimation, rms):
        chip = skin_chip(power=0x00B0 | decimation << 8, rng=np.random.default_rng(5))
        codes = []
        for _ in range(300):
            chip.advance(0.05)
            codes.append(get(chip, RESULTS, 12))
        # Rounding adds 1/12 of a code squared.
        assert np.std(codes, axis=0).mean() == pytest.approx(np.hypot(rms, 12**-0.5), rel=0.06)

    def test_inputs_have_noise_of_their_own(self):
        chip = skin_chip(rng=np.random.default_rng(5))
        chip.set_input_noise_ff([3.6 * 2] + [0.0] * 11)
        codes = []
        for _ in range(300):
            chip.advance(0.05)
            codes.append(get(chip, RESULTS, 12))
        spread = np.std(codes, axis=0)
        assert spread[0] == pytest.approx(20, rel=0.15)
        assert spread[1:].max() < 1

    def test_the_same_seed_gives_the_same_codes(self):
        def run():
            chip = skin_chip(rng=np.random.default_rng(6))
            chip.advance(0.05)
            return get(chip, RESULTS, 12)

        assert run() == run()

    def test_a_chip_without_a_generator_is_quiet(self):
        chip = skin_chip()
        chip.set_input_noise_ff(np.full(12, 10.0))
        chip.advance(1.0)
        assert len(set(get(chip, RESULTS, 12))) == 1


def test_programs_find_chip_and_bus_under_their_short_names() -> None:
    assert importlib.import_module("emulator.ad7147").AD7147 is AD7147
    assert importlib.import_module("emulator.i2c").EmulatedSMBus is EmulatedSMBus
