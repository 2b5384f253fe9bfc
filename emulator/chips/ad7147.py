"""The AD7147-1 capacitance-to-digital converter: registers, sequencer, conversion, I2C side.

Time passes only through `advance`. Conversions are computed when the chip is read or its inputs
change, but nothing depends on how often that happens: each conversion has its own noise, taken
from a table by the number of the pass, and the chip's state changes at conversions only. As long
as inputs and set-up stay the same, only the last conversion of each stage is computed; while inputs
change, a pass over the stages is computed at a time.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from emulator.chips import ad7147_map as reg
from emulator.chips.ad7147_ambient import AmbientTracking
from emulator.chips.noise import ChipNoise

_BIT = 1 << np.arange(reg.N_STAGES)
_ALL = np.ones(reg.N_STAGES, np.bool_)
_NONE = np.zeros(reg.N_STAGES, np.bool_)
_FIRST = np.zeros(1, np.intp)
#: Changes of the inputs closer together than this are stored, at most this many.
_LONGEST_PAUSE_NS = 20_000_000
_MOST_CHANGES = 256


class AD7147:
    """One chip on I2C, converting from power-up on (full power, one stage, decimation 256).

    The converter's law is
    ``code = clip(round(32768 + (C_pos - C_neg - O_pos + O_neg) / q + noise), 0, 65535)``.

    Args:
        rng: source of this chip's noise and of what its RAM holds at power-up. Without one the
            chip is noise-free and its RAM starts at zero.
        q_ff: capacitance of one code (fF). 0.36 agrees with the paper's 2.88 fF for a unit of
            eight codes; the data sheet's nominal value is 0.244 (accurate to 20-25 %), 0.32
            was measured by users near mid-scale.
        noise: of this chip's conversions, number 0 of it, of unit variance: the form of the
            noise. Normal, from `rng`, if not given.
        noise_codes_rms: rms noise in codes by the DECIMATION field (256, 128, 64, 64). [M]

    Not modelled, since no available page of the data sheet describes how: GPIO, CDC_BIAS, leakage,
    oscillator tolerance (+-3 % [M]), the words of the FIFOs in Bank 3 with MAX_AVG and MIN_AVG
    (peaks act on the offsets directly), FF_SKIP_CNT, PROXIMITY_DETECTION_RATE (proximity is
    judged by PROXIMITY_RECAL_LVL alone) and SLOW_FILTER_UPDATE_LVL.

    Attributes:
        pointer: the register that is read next.
    """

    def __init__(
        self,
        rng: np.random.Generator | None = None,
        *,
        q_ff: float = 0.36,
        noise: ChipNoise | None = None,
        noise_codes_rms: tuple[float, float, float, float] = reg.NOISE_CODES_RMS,
    ) -> None:
        if noise is None and rng is not None:
            noise = ChipNoise.of_chip(rng)
        self._noise = noise
        self._q_ff = q_ff
        self._noise_codes_rms = noise_codes_rms
        self._registers = reg.reset_registers()
        if rng is not None:
            # RAM is undefined at power-up [M].
            ram = self._registers[reg.BANK_2 :]
            ram[:] = rng.spawn(1)[0].integers(0, 1 << 16, len(ram))
        self._bind()
        self._results_ram[:] = 0
        self._capacitance_ff = np.zeros(reg.N_CINS)
        #: Capacitances that are not in `_capacitance_ff` yet, and their times.
        self._changes: list[tuple[int, NDArray[np.float64]]] = []
        self._input_noise_ff = np.zeros(reg.N_CINS)
        self._held = np.zeros(reg.N_STAGES, np.bool_)
        self._clean = np.zeros(reg.N_STAGES)
        self._unseen = np.zeros(reg.N_STAGES, bool)
        self._unreported = np.zeros(reg.N_STAGES, bool)
        #: When the pass began in which each stage was last converted.
        self._began_ns = np.zeros((1, reg.N_STAGES), np.int64)
        self._ambient = AmbientTracking(self._registers)
        self._now_ns = 0
        self._power_up()

    def _bind(self) -> None:
        """Make views of the registers by their meaning."""
        self._results = self._registers[reg.CDC_RESULT : reg.CDC_RESULT + reg.N_STAGES]
        self._results_ram = self._registers[reg.BANK_3 :: reg.RESULT_WORDS]
        self._bank_2 = self._registers[reg.BANK_2 : reg.BANK_3].reshape(-1, reg.STAGE_WORDS)

    def __setstate__(self, state: dict[str, object]) -> None:
        """A saved chip: views become views again."""
        self.__dict__.update(state)
        self._bind()
        self._ambient.bind(self._registers)

    # ------------------------------------------------------------------ the world's side

    def set_capacitance_ff(self, cin: int, value: float) -> None:
        """Change the capacitance at input `cin` (0..12) from now on (fF)."""
        if not 0 <= cin < reg.N_CINS:
            raise IndexError(f"the chip has inputs 0..{reg.N_CINS - 1}, not {cin}")
        self._convert()
        if self._capacitance_ff[cin] != value:
            self._capacitance_ff[cin] = value
            self._inputs_changed()

    def set_capacitances_ff(self, values: ArrayLike) -> None:
        """Change the capacitance of the first inputs, at most 13 of them, from now on (fF)."""
        values = np.asarray(values, np.float64)
        changes = self._changes
        before = changes[-1][1] if changes else self._capacitance_ff
        if np.array_equal(before[: len(values)], values):
            return
        pause_ns = self._now_ns - changes[-1][0] if changes else _LONGEST_PAUSE_NS
        if pause_ns >= _LONGEST_PAUSE_NS or len(changes) >= _MOST_CHANGES:
            self._convert()
        after = before.copy()
        after[: len(values)] = values
        self._changes.append((self._now_ns, after))

    def set_input_noise_ff(self, values: ArrayLike) -> None:
        """Give the first inputs separate noise (fF rms), new in each conversion.

        It represents what electrodes and solder joints pick up; it needs the chip's `rng`.
        """
        values = np.asarray(values, np.float64)
        self._settle_results()
        self._input_noise_ff[: len(values)] = values
        self._set_up_is_stale = True

    def hold_results(self, held: NDArray[np.bool_]) -> None:
        """Select results bool[12] without any noise, not even the converter's own."""
        self._settle_results()
        self._held[:] = held
        self._set_up_is_stale = True

    def advance(self, dt_s: float) -> None:
        """Let `dt_s` seconds pass (kept to the nanosecond)."""
        if dt_s < 0:
            raise ValueError(f"time cannot run backwards: dt_s is {dt_s}")
        self._now_ns += round(dt_s * 1e9)

    def brown_out(self, ram: NDArray[np.uint16]) -> None:
        """Simulate a short failure of the supply: registers are at reset, and RAM has any content.

        Args:
            ram: uint16[0x210], content of Banks 2 and 3 afterwards.
        """
        self._catch_up()
        self._registers[reg.BANK_2 :] = ram
        self._power_up()

    @property
    def interrupt(self) -> bool:
        """Whether the chip asserts its INT output."""
        self._catch_up()
        return bool(self._interrupts)

    @property
    def int_level(self) -> int:
        """Logic level of the INT pin: active low unless INT_POL is set."""
        active_high = bool(self._registers[reg.PWR_CONTROL] & 0x0800)
        return int(self.interrupt == active_high)

    # ------------------------------------------------------------------ the bus side

    def write(self, data: bytes) -> int:
        """Take one addressed write message: register address (2 bytes), then words.

        A half word or half an address at the end changes nothing [D].

        Returns:
            How many bytes the chip acknowledged. All of them, read-only and absent registers
            too, except the last byte of an SW_RESET.
        """
        if len(data) < 2:
            return len(data)
        self.pointer = (data[0] << 8 | data[1]) & 0x3FF
        for at in range(2, len(data) - 1, 2):
            value = data[at] << 8 | data[at + 1]
            if self.pointer == reg.PWR_CONTROL and value & reg.SW_RESET:
                self._catch_up()
                self._power_up()
                return at + 1
            # The pointer stops behind the end of the map: what is written there is lost.
            if self.pointer < reg.END_OF_MAP:
                self._write_register(self.pointer, value)
                self.pointer += 1
        return len(data)

    def read(self, length: int) -> bytes:
        """Answer one addressed read message of `length` bytes, high bytes first.

        The pointer moves on by whole words and survives a STOP. Behind the end of the map
        zeros are read [D].
        """
        start = self.pointer
        stop = start + (length + 1) // 2
        if start >= reg.CDC_RESULT and stop <= reg.DEVICE_ID:
            self._settle_results()
        else:
            self._catch_up()
        data = self._registers[start:stop].tobytes()[:length]
        self.pointer = max(start, min(start + length // 2, reg.END_OF_MAP))
        for status in range(reg.STAGE_LOW_INT_STATUS, reg.STAGE_COMPLETE_INT_STATUS + 1):
            if start <= status < stop:
                self._registers[status] = 0
                self._interrupts.discard(status)
        return data.ljust(length, b"\0")

    # ------------------------------------------------------------------ registers

    def _power_up(self) -> None:
        """Defaults in Bank 1; RAM keeps what it holds."""
        self._registers[: reg.BANK_2] = reg.reset_registers()[: reg.BANK_2]
        self._results_ram[:] = 0
        self.pointer = 0
        self._interrupts: set[int] = set()
        self._clean[:] = 0
        self._unseen[:] = False
        self._ambient.recalibrate()
        self._ambient.high[:] = False
        self._ambient.low[:] = False
        self._set_up_is_stale = True
        self._ideal_is_stale = True
        self._ideal = np.zeros(reg.N_STAGES)
        self._sigma = np.zeros(reg.N_STAGES)
        self._power = reg.PowerControl.of(0)
        self._restart()

    def _write_register(self, address: int, value: int) -> None:
        self._catch_up()
        mask = reg.writable_mask(address)
        before = int(self._registers[address])
        self._registers[address] = value & mask | before & ~mask
        if address < reg.BANK_3:
            self._set_up_is_stale = True
            self._steady = False
        if address == reg.PWR_CONTROL:
            power = reg.PowerControl.of(value)
            if power != self._power:
                # A new timing starts the sequence again [D].
                self._power = power
                self._restart()
        elif address == reg.AMB_COMP_CTRL0:
            if value & reg.CONV_RESET:
                self._restart(awake=self._awake)
            if value & reg.FORCED_CAL:
                # Each write with the bit set: drivers recalibrate by read-modify-write.
                self._read_set_up()
                self._ambient.recalibrate()

    def _inputs_changed(self) -> None:
        self._ideal_is_stale = True
        self._steady = False

    def _read_set_up(self) -> None:
        """Decode the set-up words, once after they changed."""
        if self._set_up_is_stale:
            self._weights, self._offset_ff = reg.decode_stages(self._bank_2)
            if not self._power.excited:
                # Without excitation neither inputs nor offset DACs carry any charge [D].
                self._weights[:], self._offset_ff[:] = 0.0, 0.0
            chip = self._noise_codes_rms[self._power.decimation]
            picked_up = np.square(self._weights) @ np.square(self._input_noise_ff / self._q_ff)
            self._sigma = np.sqrt(chip**2 + picked_up) * ~self._held
            self._ambient.configure()
            self._set_up_is_stale = False
            self._ideal_is_stale = True
        if self._ideal_is_stale:
            self._ideal = self._ideal_of(self._capacitance_ff)
            self._ideal_is_stale = False

    def _ideal_of(self, capacitance_ff: NDArray[np.float64]) -> NDArray[np.float64]:
        """Results without noise, float64[12], of the capacitances at all inputs."""
        difference_ff = self._weights @ capacitance_ff - self._offset_ff
        ideal: NDArray[np.float64] = reg.MID_SCALE + difference_ff / self._q_ff
        return ideal

    # ------------------------------------------------------------------ sequencer

    def _restart(self, *, awake: bool = False) -> None:
        """Start now at stage 0. `awake`: low power, but something is touched [M]."""
        self._awake = awake
        self._awake_until_ns = self._now_ns + (self._power_down_ns() if awake else 0)
        self._start_ns = self._now_ns
        self._position = 0
        self._steady = False
        self._ambient.restart(self._power.n_stages)

    def _catch_up(self) -> None:
        """Update results, ambient, status and interrupts to the present."""
        self._settle_results()
        self._report_unreported()

    def _settle_results(self) -> None:
        """Update results to the present, and store those that were not read yet, with noise."""
        self._convert()
        if not self._unseen.any():
            return
        codes = self._clean
        if self._noise is not None:
            codes = codes + self._sigma * self._noise.at(_FIRST, self._began_ns)[0]
        codes = np.minimum(np.maximum(np.rint(codes), 0), reg.FULL_SCALE)
        np.copyto(self._results, codes, where=self._unseen, casting="unsafe")
        self._results_ram[:] = self._results
        self._unseen[:] = False

    def _convert(self) -> None:
        """Make all conversions that have ended by now."""
        if self._changes:
            self._convert_changes()
        power = self._power
        if power.mode == reg.SHUTDOWN:
            return
        n = power.n_stages
        while True:
            ended = min(max((self._now_ns - self._start_ns) // power.stage_ns, 0), n)
            if ended <= self._position and ended < n:
                return
            if self._convert_at_once(n):
                return
            if ended > self._position:
                self._report_unreported()
                self._take(self._position, ended, self._start_ns)
                self._track(self._position, ended)
                self._position = ended
            if ended < n:
                return
            self._begin_pass(n)

    def _convert_changes(self) -> None:
        """Make the conversions during which the inputs changed; the rest has the last inputs."""
        changes, self._changes = self._changes, []
        self._read_set_up()
        if self._power.mode != reg.SHUTDOWN:
            ideals = [self._ideal_of(capacitance_ff) for _, capacitance_ff in changes]
            times_ns = np.array([t_ns for t_ns, _ in changes])
            self._convert_while(times_ns, np.stack([self._ideal, *ideals]))
        self._capacitance_ff[:] = changes[-1][1]
        self._inputs_changed()

    def _convert_while(self, times_ns: NDArray[np.int64], ideals: NDArray[np.float64]) -> None:
        """Make the conversions that end until the last of the times at which inputs changed.

        Args:
            times_ns: int64[m].
            ideals: float64[m + 1, 12], results without noise before the first of them, and
                from each on.
        """
        n, stage_ns = self._power.n_stages, self._power.stage_ns
        while True:
            ended = min(max((int(times_ns[-1]) - self._start_ns) // stage_ns, 0), n)
            if ended > self._position:
                stages = np.arange(self._position, ended)
                in_force = np.searchsorted(times_ns, self._start_ns + stage_ns * (stages + 1))
                self._report_unreported()
                self._clean[stages] = ideals[in_force, stages]
                self._unseen[stages] = True
                self._began_ns[0, stages] = self._start_ns
                self._track(self._position, ended)
                self._position = ended
            if ended < n:
                return
            self._begin_pass(n, alike=False)

    def _convert_at_once(self, n: int) -> bool:
        """Make the conversions up to now if only the last of each stage matters."""
        if self._power.mode != reg.FULL_POWER:
            return False
        passes, rest_ns = divmod(self._now_ns - self._start_ns, self._period_ns)
        stop = min(rest_ns // self._power.stage_ns, n)
        steady = self._steady
        if not steady:
            self._read_set_up()
            converted = _ALL.copy()
            converted[n:] = False
            if passes == 0:
                converted[: self._position] = converted[stop:] = False
            elif passes == 1:
                converted[stop : self._position] = False
            codes = np.where(converted, self._ideal, self._clean)
            if not self._ambient.memoryless(np.clip(codes, 0, reg.FULL_SCALE)):
                return False
            # Until an input or the set-up changes, no other code will come.
            self._steady = np.array_equal(codes[:n], self._ideal[:n])
        start_ns = self._start_ns + passes * self._period_ns
        if passes > 0:
            first = 0 if passes > 1 else self._position
            self._take(first, n, start_ns - self._period_ns)
            self._take(0, stop, start_ns)
            self._unreported[first:n] = True
            self._unreported[:stop] = True
        else:
            self._take(self._position, stop, start_ns)
            self._unreported[self._position : stop] = True
        self._start_ns = start_ns
        self._position = stop
        return True

    def _take(self, first: int, stop: int, began_ns: int) -> None:
        """Results without noise of some stages of the pass that began then."""
        self._read_set_up()
        self._clean[first:stop] = self._ideal[first:stop]
        self._unseen[first:stop] = True
        self._began_ns[0, first:stop] = began_ns

    @property
    def _period_ns(self) -> int:
        """From the start of one pass to that of the next, unless a touch changes it."""
        sleeps = self._power.mode == reg.LOW_POWER and not self._awake
        return self._power.sequence_ns + (self._power.low_power_delay_ns if sleeps else 0)

    def _begin_pass(self, n: int, *, alike: bool = True) -> None:
        """End a pass: decide when the next one starts, and count those that are `alike`."""
        end_ns = self._start_ns + self._power.sequence_ns
        was_awake = self._awake
        if self._power.mode == reg.LOW_POWER:
            if self._is_touched():
                self._awake = True
                self._awake_until_ns = end_ns + self._power_down_ns()
            elif end_ns >= self._awake_until_ns:
                self._awake = False
        period_ns = self._period_ns
        self._start_ns = end_ns + period_ns - self._power.sequence_ns
        self._position = 0
        if (
            not alike
            or was_awake != self._awake
            or not np.array_equal(self._clean[:n], self._ideal[:n])
        ):
            return
        passes = max((self._now_ns - self._start_ns) // period_ns, 0)
        passes = min(passes, self._ambient.settled_for(low_power=self._low_power))
        if self._awake:
            if self._is_touched():
                self._awake_until_ns += passes * period_ns
            else:
                # The first pass that ends after `_awake_until_ns` is computed, because it decides.
                left_ns = self._awake_until_ns - self._start_ns
                passes = min(passes, max((left_ns - 1) // period_ns, 0))
        if passes > 0:
            self._ambient.skip(passes)
            self._start_ns += passes * period_ns
            self._take(0, n, self._start_ns - period_ns)
            self._report(np.arange(reg.N_STAGES) < n, _NONE)

    @property
    def _low_power(self) -> bool:
        return self._power.mode == reg.LOW_POWER and not self._awake

    def _is_touched(self) -> bool:
        enabled_low = int(self._registers[reg.STAGE_LOW_INT_ENABLE])
        enabled_high = int(self._registers[reg.STAGE_HIGH_INT_ENABLE])
        low, high = int(self._ambient.low @ _BIT), int(self._ambient.high @ _BIT)
        return bool(low & enabled_low | high & enabled_high) or bool(self._ambient.proximity.any())

    def _power_down_ns(self) -> int:
        """PWR_DOWN_TIMEOUT x FP_PROXIMITY_CNT, counted as the proximity time is [M]."""
        control = int(self._registers[reg.AMB_COMP_CTRL0])
        quarters = 5 + (control >> 12 & 3)
        return quarters * (control >> 4 & 0xF) * 16 * self._power.sequence_ns // 4

    # ------------------------------------------------------------------ status

    def _report_unreported(self) -> None:
        """Status of conversions of which only the last mattered."""
        if self._unreported.any():
            self._track_stages(0, self._power.n_stages, self._unreported.copy())
            self._unreported[:] = False

    def _track(self, first: int, stop: int) -> None:
        done = np.zeros(reg.N_STAGES, np.bool_)
        done[first:stop] = True
        self._track_stages(first, stop, done)

    def _track_stages(self, first: int, stop: int, done: NDArray[np.bool_]) -> None:
        codes = np.minimum(np.maximum(self._clean, 0), reg.FULL_SCALE)
        changed = self._ambient.convert(first, stop, codes, low_power=self._low_power)
        self._report(done, changed)

    def _report(self, done: NDArray[np.bool_], changed: NDArray[np.bool_]) -> None:
        """Status words and interrupts.

        A threshold bit shows the state at the stage's last conversion, whether its interrupt
        is enabled or not; the interrupt comes when the state changes, either way. The
        complete bit is set for every converted stage.
        """
        registers, ambient = self._registers, self._ambient
        converted = int(done @ _BIT)
        moved = int(changed @ _BIT)
        complete = int(registers[reg.STAGE_COMPLETE_INT_STATUS]) | converted
        registers[reg.STAGE_COMPLETE_INT_STATUS] = complete
        if converted & int(registers[reg.STAGE_COMPLETE_INT_ENABLE]):
            self._interrupts.add(reg.STAGE_COMPLETE_INT_STATUS)
        for status, enable, live, state in (
            (reg.STAGE_LOW_INT_STATUS, reg.STAGE_LOW_INT_ENABLE, reg.CURRENT_LOW, ambient.low),
            (reg.STAGE_HIGH_INT_STATUS, reg.STAGE_HIGH_INT_ENABLE, reg.CURRENT_HIGH, ambient.high),
        ):
            bits = int(state @ _BIT)
            registers[status] = bits & converted | int(registers[status]) & ~converted
            registers[live] = bits
            if moved & int(registers[enable]):
                self._interrupts.add(status)
        registers[reg.PROXIMITY_STATUS] = int(ambient.proximity @ _BIT)
