"""The conversations of real drivers, each a data file, with the emulated chip."""

import numpy as np
import pytest

from emulator.chips.ad7147 import AD7147
from emulator.chips.i2c import EmulatedSMBus
from tests.support import conformance


def new_chip(q_ff=0.36):
    return AD7147(np.random.default_rng(11), q_ff=q_ff)


def play(path, chip):
    script = conformance.load(path)
    bus = EmulatedSMBus({0x2D: chip})
    done = conformance.run(script, bus, 0x2D, conformance.EmulatedBench(chip))
    assert done == len(script.steps)


@pytest.mark.parametrize("q_ff", [0.36, 0.32, 0.244])
@pytest.mark.parametrize("path", conformance.SCRIPTS, ids=lambda path: path.stem)
def test_the_driver_sees_what_it_expects(path, q_ff):
    play(path, new_chip(q_ff))


@pytest.mark.parametrize("path", conformance.SCRIPTS, ids=lambda path: path.stem)
def test_a_script_runs_without_a_bench_until_it_needs_one(path):
    script = conformance.load(path)
    bus = EmulatedSMBus({0x2C: new_chip()})
    needs_bench = conformance.Touch | conformance.Interrupt | conformance.Wait
    first = next((i for i, s in enumerate(script.steps) if isinstance(s, needs_bench)), None)
    script.steps = script.steps[:first]
    assert conformance.run(script, bus, 0x2C, None) == len(script.steps)


class _AnswersZeros(AD7147):
    def read(self, length):
        return bytes(len(super().read(length)))


@pytest.mark.parametrize("path", conformance.SCRIPTS, ids=lambda path: path.stem)
def test_a_chip_that_answers_zeros_fails_every_script(path):
    with pytest.raises(conformance.MismatchError, match="step"):
        play(path, _AnswersZeros())


class _AcknowledgesReset(AD7147):
    def write(self, data):
        super().write(data)
        return len(data)


class _KeepsInterrupt(AD7147):
    def read(self, length):
        asserted = set(self._interrupts) if self.interrupt else set()
        data = super().read(length)
        self._interrupts |= asserted
        return data


class _RemembersTouch(AD7147):
    def _report(self, done, changed):
        before = self._registers[0x009]
        super()._report(done, changed)
        self._registers[0x009] |= before


class _CompletesEnabledStagesOnly(AD7147):
    def _report(self, done, changed):
        super()._report(done, changed)
        self._registers[0x00A] &= self._registers[0x007]


class _ForgetsInShutdown(AD7147):
    def write(self, data):
        acknowledged = super().write(data)
        if data == bytes([0x00, 0x00, 0x02, 0xB3]):
            self._registers[0x080:0x0E0] = 0
        return acknowledged


@pytest.mark.parametrize(
    ("flawed", "found_by"),
    [
        (_AcknowledgesReset, "data_sheet"),
        (_KeepsInterrupt, "linux_button"),
        (_RemembersTouch, "linux_button"),
        (_CompletesEnabledStagesOnly, "linux_slider"),
        (_ForgetsInShutdown, "linux_suspend"),
    ],
)
def test_flaws_are_found(flawed, found_by):
    (path,) = (path for path in conformance.SCRIPTS if path.stem == found_by)
    with pytest.raises(conformance.MismatchError):
        play(path, flawed(np.random.default_rng(11)))
