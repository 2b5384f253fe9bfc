"""I2C bit by bit: one clock, a board's data lines, the chips on them, and their faults.

Firmware that drives lines by software uses an `I2cWire` by its pins: open-drain outputs, levels
that it reads back, and time that it lets pass. `BitMaster` is such firmware. Chips have the same
interface as on a bus of messages; their bytes are acknowledged one by one here. All faults of the
wire are at this level: buses of messages (`emulator.chips.i2c`) and boards
(`emulator.chips.converters`) go bit by bit only over faulty lines.
"""

import errno
import os
from collections.abc import Mapping, Sequence
from enum import Enum, auto
from typing import Protocol, TypeVar

import numpy as np

#: Half a period of a 400 kHz clock.
HALF_CLOCK_NS = 1250
#: A chip that lost count of the clock releases its data line after this many clocks, at the latest.
CLOCKS_OF_A_BYTE = 9
#: The levels of a released line in these clocks, as bits.
_RELEASED = (1 << CLOCKS_OF_A_BYTE) - 1
#: A line that is held low until the fault is ended.
FOR_EVER = -1

T = TypeVar("T")


class Chip(Protocol):
    """The bus side of a chip with words of 16 bits at 16-bit addresses.

    Attributes:
        pointer: the register that is read next. Only bit-level buses use it.
    """

    pointer: int

    def write(self, data: bytes) -> int:
        """Take one write message; answer how many of its bytes are acknowledged."""
        ...

    def read(self, length: int) -> bytes:
        """Answer one read message."""
        ...


class _Bytes:
    """One message of a chip, byte by byte: from its START to the next."""

    def __init__(self, chip: Chip) -> None:
        self._chip = chip
        self._taken = bytearray()
        self._low: tuple[int, int] | None = None

    def put(self, byte: int) -> bool:
        """Take a byte; whether it is acknowledged."""
        self._taken.append(byte)
        n = len(self._taken)
        if n == 2:
            return self._chip.write(bytes(self._taken)) == n
        if n < 2 or n % 2:
            return True
        message = self._chip.pointer.to_bytes(2) + self._taken[-2:]
        return self._chip.write(message) == len(message)

    def get(self) -> int:
        """The next byte. The pointer moves on with the second byte of a word."""
        chip = self._chip
        if self._low is not None:
            byte, chip.pointer = self._low
            self._low = None
            return byte
        before = chip.pointer
        high, low = chip.read(2)
        self._low = low, chip.pointer
        chip.pointer = before
        return high


class _State(Enum):
    IDLE = auto()
    #: Chips listen: to an address, or to what is written.
    LISTENING = auto()
    #: A chip sends.
    SENDING = auto()


class DataLine:
    """A data line, the chips on it, and its faults.

    Attributes:
        chips: chip by 7-bit address. The mapping is kept, so chips can come and go.
        level: of the line, as all see it; low if anybody holds it low.
        seen: its level as it was sampled at the last rise of the clock.
        faulty: any fault is on.
        asleep: nothing but the master or a fault can change anything: clocks pass it by.
    """

    def __init__(self, chips: Mapping[int, Chip], rng: np.random.Generator) -> None:
        self.chips = chips
        self.level = self.seen = True
        self.faulty = self.asleep = False
        self._rng = rng
        self._master = self._own = self._sampled = True
        self._state = _State.IDLE
        self._count = 0
        self._byte = 0
        self._number = 0
        self._address = 0
        self._acknowledged = False
        self._talks: list[_Bytes] = []
        self._carry: int | None = None
        # Faults.
        self._also: dict[int, Chip] = {}
        self._refused: dict[int, int] = {}
        self._stretched_ns: dict[int, int] = {}
        self._held_clocks = 0
        self._slips = 0
        self._slow_every = 0
        self._rises = 0
        self._flip_share = 0.0
        self._until_flip = 0

    # ------------------------------------------------------------------ faults

    def refuse(self, address: int, byte: int | None) -> None:
        """Let a chip not acknowledge byte `byte` of each message, and miss the rest; None mends it.

        Byte 0 is the address. The bytes that a chip sends are the master's to acknowledge.
        """
        _set(self._refused, address, byte)
        self._note()

    def stretch(self, address: int, hold_ns: int | None) -> None:
        """Let a chip hold the clock low after each byte of its messages; None mends it."""
        _set(self._stretched_ns, address, hold_ns)
        self._note()

    def share(self, address: int, chip: Chip | None) -> None:
        """Let a second chip answer at an address; None ends that."""
        _set(self._also, address, chip)
        self._note()

    def hold(self, clocks: int = CLOCKS_OF_A_BYTE) -> None:
        """Hold the line low until this many clocks have passed, or `FOR_EVER`; 0 ends it."""
        self._held_clocks = clocks
        self._settle(clock=False)
        self.seen = self.level
        self._note()

    def flip(self, share: float) -> None:
        """Let this share of all bits be sampled wrong, by all chips and the master; 0 ends it."""
        self._flip_share = share
        if share:
            self._until_flip = int(self._rng.geometric(share))
        self._note()

    def rise_slowly(self, n: int) -> None:
        """Let every n-th 1 that follows a 0 be sampled as 0; n = 0 ends it."""
        self._slow_every = n
        self._rises = 0
        self._note()

    def slip(self, reads: int = 1) -> None:
        """Let chips miss a clock in each of the next read messages: their bits come one late."""
        self._slips = reads
        self._note()

    @property
    def stretches(self) -> bool:
        """Whether a chip of this line holds the clock, which all lines share."""
        return bool(self._stretched_ns)

    def _note(self) -> None:
        self.asleep = False
        self.faulty = bool(
            self._also
            or self._refused
            or self._stretched_ns
            or self._held_clocks
            or self._slips
            or self._slow_every
            or self._flip_share
        )

    # ------------------------------------------------------------------ levels

    def drive(self, level: bool, *, clock: bool) -> None:
        """The master releases the line or holds it low, while the clock is at `clock`."""
        if level != self._master:
            self._master = level
            self.asleep = False
            self._settle(clock=clock)

    def _settle(self, *, clock: bool) -> None:
        level = self._master and self._own and not self._held_clocks
        if level == self.level:
            return
        self.level = level
        if not clock:
            return
        self.seen = level
        # While the clock is high the line moves for START (down) and STOP (up) only.
        self._talks = []
        self._own = True
        self._state = _State.IDLE if level else _State.LISTENING
        self._count = self._byte = self._number = 0

    def rise(self) -> None:
        """The clock rises: master and chips sample the line."""
        level = self.level
        if self._slow_every and level and not self._sampled:
            self._rises += 1
            level = self._rises % self._slow_every != 0
        if self._flip_share:
            self._until_flip -= 1
            if self._until_flip <= 0:
                level = not level
                self._until_flip = int(self._rng.geometric(self._flip_share))
        self.seen = self._sampled = level
        if self._state is _State.IDLE:
            self.asleep = level and not self.faulty
            return
        self._count += 1
        if self._state is _State.SENDING:
            self._acknowledged = not level
        elif self._count <= 8:
            self._byte = self._byte << 1 | level

    def fall(self) -> int:
        """The clock falls: chips output their next bit. Returns for how long one holds the clock,
        ns.
        """
        if self._held_clocks > 0:
            self._held_clocks -= 1
            if not self._held_clocks:
                self._note()
        held_ns = 0
        if self._state is not _State.IDLE:
            held_ns = self._listen() if self._state is _State.LISTENING else self._send()
        self.level = self._master and self._own and not self._held_clocks
        return held_ns

    # ------------------------------------------------------------------ a byte at once

    @property
    def takes_bytes(self) -> bool:
        """Whether the clocks of the next byte may be taken at once, by `clock_byte`."""
        return (self._count == 0 or self._state is _State.IDLE) and self._held_clocks <= 0

    def clock_byte(self, out: int) -> tuple[int, int]:
        """Do what `drive`, `rise` and `fall` do in the nine clocks of a byte.

        Args:
            out: what the master outputs, nine bits.

        Returns:
            The nine bits that were sampled; and for how long a chip holds the clock then, ns.
        """
        if self.asleep and out == _RELEASED:
            return out, 0
        self.asleep = False
        held_ns = 0
        # Held for ever: nobody sees a 1.
        free = 0 if self._held_clocks else out
        if self._state is _State.IDLE:
            taken = self._sample(free, CLOCKS_OF_A_BYTE)
            self.asleep = self.seen and not self.faulty
        elif self._state is _State.SENDING:
            byte = self._sample(free >> 1 & self._byte, 8)
            taken = byte << 1 | self._sample(free & 1, 1)
            self._acknowledged = not taken & 1
            self._count = CLOCKS_OF_A_BYTE
            held_ns = self._send()
        else:
            self._byte = byte = self._sample(free >> 1, 8)
            self._count = 8
            self._listen()
            if self._state is _State.LISTENING:
                taken = byte << 1 | self._sample(0, 1)
                self._count = CLOCKS_OF_A_BYTE
                held_ns = self._listen()
            else:
                taken = byte << 1 | self._sample(free & 1, 1)
                self.asleep = self.seen and not self.faulty
        self._master = bool(out & 1)
        self.level = self._master and self._own and not self._held_clocks
        return taken, held_ns

    def _sample(self, levels: int, n: int) -> int:
        """The bits that are sampled of a line with these levels."""
        if self._slow_every or self._flip_share:
            levels = self._disturbed(levels, n)
        self.seen = self._sampled = bool(levels & 1)
        return levels

    def _disturbed(self, levels: int, n: int) -> int:
        """The same where bits are flipped, or rise slowly; nearly always none of so few is."""
        every = self._slow_every
        rises = (levels & ~(self._sampled << n - 1 | levels >> 1)).bit_count() if every else 0
        is_flipped = self._flip_share and self._until_flip <= n
        if not is_flipped and (not every or self._rises % every + rises < every):
            self._rises += rises
            if self._flip_share:
                self._until_flip -= n
            return levels
        taken = 0
        for bit in range(n - 1, -1, -1):
            level = bool(levels >> bit & 1)
            if every and level and not self._sampled:
                self._rises += 1
                level = self._rises % every != 0
            if self._flip_share:
                self._until_flip -= 1
                if self._until_flip <= 0:
                    level = not level
                    self._until_flip = int(self._rng.geometric(self._flip_share))
            self._sampled = level
            taken = taken << 1 | level
        return taken

    # ------------------------------------------------------------------ the chips

    def _listen(self) -> int:
        if self._count == 8:
            if not self._take():
                self._state = _State.IDLE
                return 0
            self._own = False
        elif self._count == CLOCKS_OF_A_BYTE:
            self._own = True
            reads = self._number == 0 and self._byte & 1
            self._count = self._byte = 0
            self._number += 1
            if reads:
                self._state = _State.SENDING
                self._begin_to_send()
            return self._stretched_ns.get(self._address, 0)
        return 0

    def _take(self) -> bool:
        """Let the chips take a byte; whether any acknowledges it. Those that do not are gone."""
        if self._number == 0:
            self._address = self._byte >> 1
            found = (self.chips.get(self._address), self._also.get(self._address))
            self._talks = [_Bytes(chip) for chip in found if chip is not None]
        if self._refused.get(self._address) == self._number:
            self._talks = []
        elif self._number:
            self._talks = [talk for talk in self._talks if talk.put(self._byte)]
        return bool(self._talks)

    def _begin_to_send(self) -> None:
        self._carry = None
        if self._slips:
            # What is seen of the clock that was missed is the released line of the acknowledge.
            self._carry = 1
            self._slips -= 1
            self._note()
        self._load()

    def _load(self) -> None:
        """Load the next byte of the chips that send: a 0 of any of them wins."""
        byte = 0xFF
        for talk in self._talks:
            byte &= talk.get()
        if self._carry is not None:
            byte, self._carry = self._carry << 7 | byte >> 1, byte & 1
        self._byte = byte
        self._count = 0
        self._own = bool(byte & 0x80)

    def _send(self) -> int:
        if self._count < 8:
            self._own = bool(self._byte << self._count & 0x80)
        elif self._count == 8:
            self._own = True
        else:
            if self._acknowledged:
                self._load()
            else:
                self._own = True
                self._state = _State.IDLE
            return self._stretched_ns.get(self._address, 0)
        return 0


class I2cWire:
    """One clock and some data lines, driven by its pins.

    All outputs are open drain: a pin that is set high is released, and reads what the line is.
    Lines are bits of an integer: bit i is data line i.

    Args:
        chips: those of each data line, by address.
        rng: for what is left to chance.

    Attributes:
        lines: the data lines, which have the faults.
        t_ns: time that `wait` has let pass.
    """

    def __init__(
        self, chips: Sequence[Mapping[int, Chip]], rng: np.random.Generator | None = None
    ) -> None:
        rng = rng or np.random.default_rng(0)
        self.lines = [DataLine(on_line, rng) for on_line in chips]
        self.t_ns = 0
        self._clock = self._released = True
        self._levels = -1
        self._held_until_ns = 0

    @property
    def faulty(self) -> int:
        """Lines that must go bit by bit; all of them where one holds the clock."""
        faulty = 0
        for number, line in enumerate(self.lines):
            if line.faulty:
                if line.stretches:
                    return (1 << len(self.lines)) - 1
                faulty |= 1 << number
        return faulty

    @property
    def sda(self) -> int:
        """Levels of the data lines; while the clock is high, those that were sampled."""
        levels = 0
        for number, line in enumerate(self.lines):
            if line.seen if self._clock else line.level:
                levels |= 1 << number
        return levels

    def set_scl(self, level: bool) -> None:
        """Release the clock or hold it low."""
        self._released = level
        if not level:
            if self._clock:
                self._clock = False
                held_ns = max([line.fall() for line in self.lines if not line.asleep], default=0)
                if held_ns:
                    self._held_until_ns = self.t_ns + held_ns
        elif not self._clock and self.t_ns >= self._held_until_ns:
            self._rise()

    def clock_byte(self, out: int, lines: int, half_ns: int) -> list[int] | None:
        """Do at once what a master does with its pins in the nine clocks of a byte.

        Args:
            out: what it outputs, nine bits; the clock is low before and after.
            lines: where it does; it releases the others.
            half_ns: half a period of the clock.

        Returns:
            The nine bits that were sampled on each line; None if it must go bit by bit, because
            something may happen amid the byte. Then nothing was done.
        """
        if self._clock or self.t_ns < self._held_until_ns:
            return None
        awake = [number for number, line in enumerate(self.lines) if not line.asleep]
        for number in awake:
            if not self.lines[number].takes_bytes:
                return None
        self.t_ns += 2 * CLOCKS_OF_A_BYTE * half_ns
        self._released = False
        self._levels = -1 if out & 1 else ~lines
        taken = [_RELEASED] * len(self.lines)
        longest_ns = 0
        moved = awake if out == _RELEASED else range(len(self.lines))
        for number in moved:
            line = self.lines[number]
            taken[number], held_ns = line.clock_byte(out if lines >> number & 1 else _RELEASED)
            longest_ns = max(longest_ns, held_ns)
        self._held_until_ns = self.t_ns + longest_ns
        return taken

    def clock(self, levels: int, half_ns: int) -> int:
        """Do what a master that does not look at the clock does with its pins in one clock.

        Args:
            levels: what it outputs, see `set_sda`; the clock is low before and after.
            half_ns: half a period of the clock.

        Returns:
            The levels that were sampled in the middle.
        """
        if levels != self._levels:
            self.set_sda(levels)
        self.t_ns += half_ns
        if not self._clock and self.t_ns >= self._held_until_ns:
            return self._up_and_down(half_ns)
        sampled = self.sda
        self.t_ns += half_ns
        if not self._clock and self.t_ns >= self._held_until_ns:
            self._rise()
        self.set_scl(False)
        return sampled

    def _up_and_down(self, half_ns: int) -> int:
        """Let the clock rise, and fall after a while; returns the levels that were sampled."""
        self.t_ns += half_ns
        self._released = False
        sampled = longest_ns = 0
        for number, line in enumerate(self.lines):
            if not line.asleep:
                line.rise()
            if line.seen:
                sampled |= 1 << number
            if not line.asleep:
                longest_ns = max(longest_ns, line.fall())
        if longest_ns:
            self._held_until_ns = self.t_ns + longest_ns
        return sampled

    def set_sda(self, levels: int) -> None:
        """Release data lines (1) or hold them low (0)."""
        changed = (levels ^ self._levels) & ((1 << len(self.lines)) - 1)
        self._levels = levels
        while changed:
            number = changed.bit_length() - 1
            changed ^= 1 << number
            self.lines[number].drive(bool(levels >> number & 1), clock=self._clock)

    def wait(self, dt_ns: int) -> None:
        """Let time pass. A clock that a chip held rises when the chip releases it."""
        self.t_ns += dt_ns
        if self._released and not self._clock and self.t_ns >= self._held_until_ns:
            self._rise()

    def wait_for_clock(self, longest_ns: int) -> bool:
        """Let time pass until a released clock has risen; whether it has in that time."""
        if not self._clock:
            self.wait(min(max(self._held_until_ns - self.t_ns, 0), longest_ns))
        return self._clock

    def _rise(self) -> None:
        self._clock = True
        for line in self.lines:
            if not line.asleep:
                line.rise()


class BitMaster:
    """A master that bangs the bits of some data lines of a wire together.

    Args:
        wire: the lines and their clock.
        lines: which ones, as bits.
        patience_ns: how long it waits for a clock that a chip holds. None: it looks neither at
            the clock nor at acknowledges, as boards' firmware does.
        half_ns: half a period of the clock.

    Raises:
        OSError: ETIMEDOUT from a patient one: the clock or a data line stays low.
    """

    def __init__(
        self,
        wire: I2cWire,
        lines: int = 1,
        *,
        patience_ns: int | None = None,
        half_ns: int = HALF_CLOCK_NS,
    ) -> None:
        self._wire = wire
        self._lines = lines
        self._patience_ns = patience_ns
        self._half_ns = half_ns

    def start(self) -> None:
        """START, or another one within a transaction."""
        self._sda(high=True)
        self._wire.wait(self._half_ns)
        self._up()
        if self._patience_ns is not None and self._wire.sda & self._lines != self._lines:
            raise timed_out()
        self._sda(high=False)
        self._wire.wait(self._half_ns)
        self._wire.set_scl(False)

    def stop(self) -> None:
        """STOP."""
        self._sda(high=False)
        self._wire.wait(self._half_ns)
        self._up()
        self._sda(high=True)
        self._wire.wait(self._half_ns)

    def put(self, byte: int) -> int:
        """Send a byte on all lines; those that acknowledge it, as bits."""
        taken = self._wire.clock_byte(byte << 1 | 1, self._lines, self._half_ns)
        if taken is not None:
            acknowledged = sum((~bits & 1) << number for number, bits in enumerate(taken))
            return acknowledged & self._lines
        for bit in range(7, -1, -1):
            self._clocked(high=bool(byte >> bit & 1))
        return ~self._clocked(high=True) & self._lines

    def get(self, *, acknowledge: bool) -> list[int]:
        """Take a byte from each of the wire's lines."""
        out = _RELEASED - acknowledge
        taken = self._wire.clock_byte(out, self._lines, self._half_ns)
        if taken is not None:
            return [bits >> 1 for bits in taken]
        samples = [self._clocked(high=True) for _ in range(8)]
        self._clocked(high=not acknowledge)
        values = []
        for number in range(len(self._wire.lines)):
            value = 0
            for sample in samples:
                value = value << 1 | sample >> number & 1
            values.append(value)
        return values

    def recover(self) -> None:
        """Nine clocks and a STOP: a chip that holds the line amid a byte releases it."""
        for _ in range(CLOCKS_OF_A_BYTE):
            self._clocked(high=True)
        self.stop()

    def _clocked(self, *, high: bool) -> int:
        """One clock; the levels that were sampled meanwhile."""
        if self._patience_ns is None:
            return self._wire.clock(-1 if high else ~self._lines, self._half_ns)
        self._sda(high=high)
        self._wire.wait(self._half_ns)
        self._up()
        levels = self._wire.sda
        self._wire.wait(self._half_ns)
        self._wire.set_scl(False)
        return levels

    def _up(self) -> None:
        self._wire.set_scl(True)
        if self._patience_ns is not None and not self._wire.wait_for_clock(self._patience_ns):
            raise timed_out()

    def _sda(self, *, high: bool) -> None:
        self._wire.set_sda(-1 if high else ~self._lines)


def timed_out() -> OSError:
    """What an adapter reports of a bus that is held low."""
    return OSError(errno.ETIMEDOUT, os.strerror(errno.ETIMEDOUT))


def _set(table: dict[int, T], key: int, value: T | None) -> None:
    if value is None:
        table.pop(key, None)
    else:
        table[key] = value
