"""The AD7147-1 capacitance-to-digital converter: registers, sequencer, conversion, I2C side.

Time passes only through `advance`. Conversions are worked out when somebody looks: as long as
capacitances and set-up stay the same, only the last conversion of each stage matters, and its
noise is drawn when the result is first seen. An hour without a read costs nothing.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from emulator import ad7147_map as reg
from emulator.ad7147_ambient import AmbientTracking

_BIT = 1 << np.arange(reg.N_STAGES)


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
        noise_codes_rms: rms noise in codes by the DECIMATION field (256, 128, 64, 64). [M]

    Not modelled: GPIO, CDC_BIAS, leakage, the words of the two FIFOs in Bank 3, oscillator
    tolerance (+-3 % [M]).
    """

    def __init__(
        self,
        rng: np.random.Generator | None = None,
        *,
        q_ff: float = 0.36,
        noise_codes_rms: tuple[float, float, float, float] = reg.NOISE_CODES_RMS,
    ) -> None:
        self._rng = rng
        self._q_ff = q_ff
        self._noise_codes_rms = noise_codes_rms
        self._registers = reg.reset_registers()
        if rng is not None:
            # RAM is undefined at power-up [M]. A spawned generator leaves the noise alone.
            ram = self._registers[reg.BANK_2 :]
            ram[:] = rng.spawn(1)[0].integers(0, 1 << 16, len(ram))
        self._results = self._registers[reg.CDC_RESULT : reg.CDC_RESULT + reg.N_STAGES]
        self._results_ram = self._registers[reg.BANK_3 :: reg.RESULT_WORDS]
        self._results_ram[:] = 0
        self._bank_2 = self._registers[reg.BANK_2 : reg.BANK_3].reshape(-1, reg.STAGE_WORDS)
        self._capacitance_ff = np.zeros(reg.N_CINS)
        self._input_noise_ff = np.zeros(reg.N_CINS)
        self._held = np.zeros(reg.N_STAGES, np.bool_)
        self._clean = np.zeros(reg.N_STAGES)
        self._unseen = np.zeros(reg.N_STAGES, bool)
        self._ambient = AmbientTracking(self._registers)
        self._now_ns = 0
        self._power_up()

    # ------------------------------------------------------------------ the world's side

    def set_capacitance_ff(self, cin: int, value: float) -> None:
        """Change the capacitance at input `cin` (0..12) from now on (fF)."""
        if not 0 <= cin < reg.N_CINS:
            raise IndexError(f"the chip has inputs 0..{reg.N_CINS - 1}, not {cin}")
        if self._capacitance_ff[cin] != value:
            self._close_interval()
            self._capacitance_ff[cin] = value
            self._ideal_is_stale = True

    def set_capacitances_ff(self, values: ArrayLike) -> None:
        """Change the capacitance of the first inputs, at most 13 of them, from now on (fF)."""
        values = np.asarray(values, np.float64)
        self._close_interval()
        self._capacitance_ff[: len(values)] = values
        self._ideal_is_stale = True

    def set_input_noise_ff(self, values: ArrayLike) -> None:
        """Give the first inputs a noise of their own (fF rms), new in each conversion.

        It stands for what electrodes and solder joints pick up; it needs the chip's `rng`.
        """
        values = np.asarray(values, np.float64)
        self._input_noise_ff[: len(values)] = values
        self._set_up_is_stale = True

    def hold_results(self, held: NDArray[np.bool_]) -> None:
        """Results bool[12] that show no noise at all, not even the converter's own."""
        self._held[:] = held
        self._set_up_is_stale = True

    def advance(self, dt_s: float) -> None:
        """Let `dt_s` seconds pass (kept to the nanosecond)."""
        if dt_s < 0:
            raise ValueError(f"time cannot run backwards: dt_s is {dt_s}")
        self._now_ns += round(dt_s * 1e9)

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
        self._pointer = (data[0] << 8 | data[1]) & 0x3FF
        for at in range(2, len(data) - 1, 2):
            value = data[at] << 8 | data[at + 1]
            if self._pointer == reg.PWR_CONTROL and value & reg.SW_RESET:
                self._power_up()
                return at + 1
            # The pointer stops behind the end of the map: what is written there is lost.
            if self._pointer < reg.END_OF_MAP:
                self._write_register(self._pointer, value)
                self._pointer += 1
        return len(data)

    def read(self, length: int) -> bytes:
        """Answer one addressed read message of `length` bytes, high bytes first.

        The pointer moves on by whole words and survives a STOP. Behind the end of the map
        zeros are read [D].
        """
        start = self._pointer
        stop = start + (length + 1) // 2
        if start >= reg.CDC_RESULT and stop <= reg.DEVICE_ID and not self._sleeps_between:
            self._take_conversions(self._ended(self._now_ns))
        else:
            self._catch_up()
        self._settle_results()
        data = self._registers[start:stop].tobytes()[:length]
        self._pointer = max(start, min(start + length // 2, reg.END_OF_MAP))
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
        self._pointer = 0
        self._interrupts: set[int] = set()
        self._clean[:] = 0
        self._unseen[:] = False
        self._ambient.recalibrate()
        self._set_up_is_stale = True
        self._ideal_is_stale = True
        self._ideal = np.zeros(reg.N_STAGES)
        self._sigma = np.zeros(reg.N_STAGES)
        self._power = reg.PowerControl.of(0)
        self._restart(self._now_ns, awake=False)

    def _write_register(self, address: int, value: int) -> None:
        self._catch_up()
        mask = reg.writable_mask(address)
        before = int(self._registers[address])
        self._registers[address] = value & mask | before & ~mask
        if address < reg.BANK_3:
            self._set_up_is_stale = True
        if address == reg.PWR_CONTROL:
            power = reg.PowerControl.of(value)
            if power != self._power:
                # A new timing starts the sequence again [D].
                self._power = power
                self._restart(self._now_ns, awake=False)
        elif address == reg.AMB_COMP_CTRL0:
            if value & reg.CONV_RESET:
                self._restart(self._now_ns, awake=self._awake)
            if value & ~before & reg.FORCED_CAL:
                self._ambient.recalibrate()

    def _read_set_up(self) -> None:
        """Work out what the set-up words mean, once after they changed."""
        if self._set_up_is_stale:
            self._weights, self._offset_ff = reg.decode_stages(self._bank_2)
            chip = self._noise_codes_rms[self._power.decimation]
            picked_up = np.square(self._weights) @ np.square(self._input_noise_ff / self._q_ff)
            self._sigma = np.sqrt(chip**2 + picked_up) * ~self._held
            self._ambient.configure()
            self._set_up_is_stale = False
            self._ideal_is_stale = True
        if self._ideal_is_stale:
            difference_ff = self._weights @ self._capacitance_ff - self._offset_ff
            self._ideal = reg.MID_SCALE + difference_ff / self._q_ff
            self._ideal_is_stale = False

    # ------------------------------------------------------------------ sequencer

    @property
    def _sleeps_between(self) -> bool:
        return self._power.mode == reg.LOW_POWER

    def _restart(self, at_ns: int, *, awake: bool) -> None:
        """Start at stage 0. `awake`: low power, but something is touched [M]."""
        power = self._power
        self._awake = awake
        self._awake_until_ns = at_ns + (self._power_down_ns() if awake else 0)
        self._start_ns = at_ns
        self._period_ns = power.sequence_ns
        if power.mode == reg.LOW_POWER and not awake:
            self._period_ns += power.low_power_delay_ns
        self._taken = 0
        self._tracked = 0

    def _ended(self, at_ns: int) -> int:
        """How many conversions have ended since the last restart."""
        if self._power.mode == reg.SHUTDOWN:
            return 0
        sequences, rest_ns = divmod(at_ns - self._start_ns, self._period_ns)
        n = self._power.n_stages
        return sequences * n + min(rest_ns // self._power.stage_ns, n)

    def _take_conversions(self, ended: int) -> None:
        """Set the noise-free result of each stage that was converted since the last look."""
        new = ended - self._taken
        if new <= 0:
            return
        self._read_set_up()
        n = self._power.n_stages
        stages = slice(n) if new >= n else np.arange(self._taken, ended) % n
        self._clean[stages] = self._ideal[stages]
        self._unseen[stages] = True
        self._taken = ended

    def _close_interval(self) -> None:
        """Account for the conversions made with the inputs as they were."""
        if self._ambient.memoryless and not self._sleeps_between:
            self._take_conversions(self._ended(self._now_ns))
        else:
            self._catch_up()

    def _settle_results(self) -> None:
        """Draw the noise of results nobody has seen yet, and store them."""
        if not self._unseen.any():
            return
        codes = self._clean
        if self._rng is not None:
            codes = codes + self._sigma * self._rng.standard_normal(reg.N_STAGES)
        codes = np.minimum(np.maximum(np.rint(codes), 0), reg.FULL_SCALE)
        np.copyto(self._results, codes, where=self._unseen, casting="unsafe")
        self._results_ram[:] = self._results
        self._unseen[:] = False

    def _catch_up(self) -> None:
        """Bring results, ambient, status and interrupts to the present."""
        while self._sleeps_between:
            if self._awake:
                switch_ns = self._awake_until_ns
                self._track(min(self._now_ns, switch_ns))
                if self._is_touched():
                    self._awake_until_ns = self._now_ns + self._power_down_ns()
                    break
                if self._now_ns < switch_ns:
                    return
                self._restart(switch_ns, awake=False)
            else:
                # Inputs are unchanged, so the first sequence decides for all that follow.
                sequence = self._tracked // self._power.n_stages
                switch_ns = self._start_ns + sequence * self._period_ns + self._power.sequence_ns
                if switch_ns > self._now_ns:
                    break
                self._track(switch_ns)
                if not self._is_touched():
                    break
                self._restart(switch_ns, awake=True)
        self._track(self._now_ns)

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

    def _track(self, until_ns: int) -> None:
        ended = self._ended(until_ns)
        if ended <= self._tracked:
            return
        self._take_conversions(ended)
        n = self._power.n_stages
        ahead = n - 1 - np.arange(reg.N_STAGES)
        counts = (ended + ahead) // n - (self._tracked + ahead) // n
        counts[n:] = 0
        self._tracked = ended
        codes = np.minimum(np.maximum(self._clean, 0), reg.FULL_SCALE)
        changed = self._ambient.update(
            counts, codes, low_power=self._sleeps_between and not self._awake
        )
        self._report(counts > 0, changed)

    def _report(self, done: NDArray[np.bool_], changed: NDArray[np.bool_]) -> None:
        """Status words and interrupts.

        A threshold bit tells the state at the stage's last conversion, whether its interrupt
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
