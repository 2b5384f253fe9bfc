"""MTB3: a dsPIC board with one main loop, 16-bit arithmetic and stacks for queues.

Sources: mtb3/main_V3.c, mtb3/can_interface.c and mtb3/options.h, icub-firmware.
"""

from typing import ClassVar

import numpy as np

from emulator.boards.arithmetic import transmit_16, transmit_legacy
from emulator.boards.board import BOOTLOADER_S, Frame, Identity, Mtb
from emulator.boards.chip_access import CHIPS_PER_LINE, Chips, StageMap
from skin_host.bus.answers import PingAnswer, ResetAnswer, answer_frame
from skin_host.bus.commands import (
    BoardType,
    Discover,
    EnterBootloader,
    GetAdditionalInfo,
    GetFirmwareVersion,
    Management,
    Message,
    Ping,
    SetAdditionalInfo,
    SetBoardAddress,
    SetBoardConfig,
    SetTriangleConfig,
    SetTxMode,
    TactileSetup,
    TactileSetup2,
    parse_command,
)
from skin_host.bus.compensation import NO_GAIN
from skin_host.bus.wire import (
    BROADCAST_ADDRESS,
    HEADER_A,
    TRIANGLES,
    FrameBatch,
    MessageClass,
    identifier,
)

#: The sampling timer counts at 312.5 kHz.
TIMER_TICK_NS = 3200
#: PWR_CONTROL and timer by decimation field 1, 2, 3 (256, 128, 64) of command 4C.
POWER_CONTROLS = {
    StageMap.SINGLE: (0x00B0, 0x01B0, 0x02B0),
    StageMap.THREE: (0x0010, 0x0110, 0x0210),
    StageMap.FINGERTIP: (0x0010, 0x0110, 0x0210),
    StageMap.ALL: (0x0000, 0x0100, 0x0200),
}
TIMERS = {
    StageMap.SINGLE: (0x3D1C, 0x2D00, 0x1A00),
    # A missing `break` lets the set-up for fingertips replace the one for thirds.
    StageMap.THREE: (0x3D1C, 0x2D00, 0x3D1C),
    StageMap.FINGERTIP: (0x3D1C, 0x2D00, 0x3D1C),
    StageMap.ALL: (0x1A00, 0x1A00, 0x1A00),
}
#: Five entries, but the index never reaches the last.
RECEIVE_ENTRIES = 4
NO_ACKS_TO_CALIBRATE = 5
#: Reading 16 chips at 300 kHz, and waiting for a frame to be sent (ns).
READ_NS, FRAME_NS = 3_400_000, 112_500
#: With all triangles: the loop is never faster.
SHORTEST_CYCLE_NS = READ_NS + 2 * TRIANGLES * FRAME_NS
SHIFT_THREE, SHIFT_ALL = 3, 4
PERIODS_TO_CALIBRATE = 2
ANY_SENDER = 0x70F


class Mtb3(Mtb):
    """The MTB3.

    Commands are executed by the main loop, newest first, and not while it reads the chips and
    sends a burst, nor while it calibrates; that takes two periods. Command 50 makes the board send
    by itself afterwards. Any frame of class 7 stops the sampling timer until 07, 50, 4C, 4E or
    (while sending) 4D.

    The transmit queue is a stack: the emulator sends the newest frame of every 20 first. In
    the source the loop waits for an idle controller before it stacks a second frame, so a
    quiet bus may see them in order: expect either.
    """

    identity: ClassVar[Identity] = Identity(BoardType.SKIN, (2, 17, 0), (1, 0))
    arithmetic = staticmethod(transmit_16)
    stack_size: ClassVar[int | None] = 20

    def __init__(self, address: int, chips: Chips) -> None:
        # One mailbox takes 0x2xN and 0x7xF, the other 0x7xN; each keeps stale bytes.
        self._mailboxes = [bytearray(8), bytearray(8)]
        super().__init__(address, chips)

    def reset(self, t_ns: int) -> None:
        """As after power-up: chips set up, baseline two periods later, silent, class 3."""
        self._defaults(period_ms=0, no_load=245)
        self.start_ns = t_ns
        self._stages = StageMap.SINGLE
        self._power_control = POWER_CONTROLS[StageMap.SINGLE][0]
        self._period(TIMERS[StageMap.SINGLE][0])
        self._shift_three, self._shift_all = SHIFT_THREE, SHIFT_ALL
        self._compensates = True
        self._sending = False
        self._starts_after_calibration = False
        self._new_format = False
        self._received: list[tuple[int, bytes]] = []
        self._answers: list[Frame] = []
        self._to_update = np.zeros(TRIANGLES, bool)
        self._calibrate_at_tick = False
        self._baseline_ns: int | None = None
        self._back_ns: int | None = None
        #: Until then the loop reads the chips and sends.
        self._busy_until_ns = t_ns
        self._restart_ns: int | None = None
        self._configure_all()
        self._begin_calibration(t_ns)

    def thermal(self, triangle: int) -> tuple[tuple[int, ...], int]:
        """Types 0 and 1 only; 4E can switch the compensation off."""
        gains, taxel = super().thermal(triangle)
        known = self._compensates and self.skin_type == 0
        return (gains if known else NO_GAIN), taxel

    @property
    def message_class(self) -> MessageClass:
        """Class 4 once 4D, 50 or 07 00 has been received, class 3 before."""
        return MessageClass.SKIN_STREAM if self._new_format else MessageClass.ANALOG_STREAM

    @property
    def alone(self) -> bool:
        """The reduced formats are made one by one."""
        return self._stages is not StageMap.SINGLE

    # ------------------------------------------------------------------ time

    def advance(self, t_ns: int) -> bool:
        """Run the main loop up to `t_ns`."""
        if self._restart_ns is not None:
            if t_ns < self._restart_ns:
                return False
            self.reset(t_ns)
        self._calibrate(t_ns)
        if self._back_ns is not None:
            return False
        if t_ns >= self._busy_until_ns:
            self._run_received(t_ns)
        if self.next_ns is None or t_ns < self.next_ns:
            return False
        self.next_ns += max(self.period_ns, SHORTEST_CYCLE_NS)
        if self.next_ns <= t_ns:
            self.next_ns = t_ns + self.period_ns
        if self._calibrate_at_tick:
            self._calibrate_at_tick = False
            for triangle in np.flatnonzero(self._to_update):
                offset = int(self.cdc_offset[triangle])
                self.chips.configure([int(triangle)], self._stages, offset, self._power_control)
            self._to_update[:] = False
            self._begin_calibration(t_ns)
            return False
        frames = 2 * int(np.count_nonzero(self.triangles))
        self._busy_until_ns = t_ns + READ_NS + frames * FRAME_NS
        return self._sending or self._stages is not StageMap.SINGLE

    @property
    def due_ns(self) -> int | None:
        """The next tick, or the next stage of a calibration or restart."""
        if self._restart_ns is not None:
            return self._restart_ns
        if self._baseline_ns is not None:
            return self._baseline_ns
        if self._back_ns is not None:
            return self._back_ns
        if self._received:
            return self._busy_until_ns
        return self.next_ns

    def count_no_ack(self, triangles: int) -> None:
        """The fifth bad reading since the last time re-baselines the whole board."""
        self.no_acks += triangles
        if self.no_acks >= NO_ACKS_TO_CALIBRATE:
            self.no_acks = 0
            self._calibrate_at_tick = True

    def answers(self) -> list[Frame]:
        """Return the answers of the main loop since the last call."""
        answers, self._answers = self._answers, []
        return answers

    def sample(self, t_ns: int) -> FrameBatch:
        """As all boards, or one of the reduced formats (class 3, DLC 2 or 4)."""
        if self._stages is StageMap.SINGLE:
            return super().sample(t_ns)
        if self._stages is StageMap.FINGERTIP:
            return FrameBatch.of([])
        n_values, shift = (
            (1, self._shift_all) if self._stages is StageMap.ALL else (3, self._shift_three)
        )
        raw = self.chips.read()[:TRIANGLES, :n_values]
        values = transmit_legacy(raw, self.base[:TRIANGLES, :n_values], shift)
        frames = [
            (
                identifier(MessageClass.ANALOG_STREAM, self.address, triangle),
                bytes([HEADER_A]) + values[triangle].tobytes(),
                t_ns,
            )
            for triangle in range(TRIANGLES)
        ]
        return FrameBatch.of(frames[::-1])

    def _period(self, timer: int) -> None:
        self.period_ns = (timer & 0xFFFF) * TIMER_TICK_NS

    def _run_timer(self, t_ns: int) -> None:
        """Enable the timer's interrupt; it has gone on counting, so the phase stays."""
        if self.next_ns is None:
            self.next_ns = t_ns + self.period_ns

    def _begin_calibration(self, t_ns: int) -> None:
        """The loop waits for one period, reads the chips, and waits for another."""
        self._baseline_ns = t_ns + self.period_ns
        self._back_ns = t_ns + PERIODS_TO_CALIBRATE * self.period_ns

    def _calibrate(self, t_ns: int) -> None:
        if self._baseline_ns is not None and t_ns >= self._baseline_ns:
            self._baseline_ns = None
            self._take_baseline()
        if self._back_ns is not None and t_ns >= self._back_ns:
            # The flag is tested inverted: after command 50 the stream continues by itself.
            self._sending |= self._starts_after_calibration
            self.next_ns = self._back_ns + self.period_ns if self._timer_wanted() else None
            self._back_ns = None

    def _timer_wanted(self) -> bool:
        return self._sending or self._stages is not StageMap.SINGLE

    # ------------------------------------------------------------------ commands

    def handle(self, can_id: int, data: bytes, t_ns: int) -> list[Frame]:
        """Put a frame that passes the filters on the stack; run it if the loop is free.

        The filters take 0x2xN, 0x7xN and 0x7xF; the broadcast 0x2xF is ignored. All eight
        bytes of the mailbox are copied, so those that were not sent are old ones.
        """
        match can_id & ANY_SENDER:
            case masked if masked in {0x200 | self.address, 0x700 | BROADCAST_ADDRESS}:
                mailbox = self._mailboxes[0]
            case masked if masked == 0x700 | self.address:
                mailbox = self._mailboxes[1]
            case _:
                return []
        mailbox[: len(data)] = data
        del self._received[RECEIVE_ENTRIES - 1 :]
        self._received.append((can_id, bytes(mailbox)))
        self._run_if_free(t_ns)
        return self.answers()

    def _run_if_free(self, t_ns: int) -> None:
        """Run what has been received, if the main loop gets to it, or the bootloader's."""
        is_busy = self._back_ns is not None or t_ns < self._busy_until_ns
        if self._restart_ns is not None or not is_busy:
            self._run_received(t_ns)

    def _run_received(self, t_ns: int) -> None:
        while self._received:
            can_id, data = self._received.pop()
            if can_id >> 8 == MessageClass.MANAGEMENT:
                self.next_ns = None
            parsed = parse_command(can_id & ANY_SENDER, data)
            if parsed is None:
                continue
            receiver, command = parsed
            self.version += 1
            sender = can_id >> 4 & 0xF
            address = self.address
            self._answers += [
                (answer_id | sender, payload)
                for answer_id, payload in (
                    answer_frame(answer, address)
                    for answer in self._obey(command, t_ns, addressed=receiver == address)
                )
            ]

    def _obey(self, command: Message, t_ns: int, *, addressed: bool) -> list[Message]:
        if self._restart_ns is not None:
            return self._obey_in_bootloader(command, t_ns)
        if isinstance(command, Management):
            return self._obey_management(command, t_ns, addressed=addressed)
        match command:
            case SetBoardAddress(address):
                self.address = address & 0xF
                self.version += 1
            case SetBoardConfig(skin_type, period_ms, no_load):
                self._new_format = True
                self.skin_type = skin_type & 0xF
                self.no_load = no_load
                self._period(period_ms * 625 >> 1)
                self._set_triangles(0, TRIANGLES - 1, enabled=False)
                if self._sending:
                    self._run_timer(t_ns)
            case SetTriangleConfig(first, last, shift, flags, cdc_offset):
                self._new_format = True
                if first > last or last >= TRIANGLES:
                    return []
                self._set_triangles(first, last, enabled=bool(flags & 1))
                self.shift[first : last + 1] = min(shift, 15)
                self.cdc_offset[first : last + 1] = cdc_offset
                self._to_update[first : last + 1] = True
                self._calibrate_at_tick = True
                self._starts_after_calibration = True
                self._sending = False
                self._run_timer(t_ns)
            case SetTxMode(mode):
                self._new_format |= mode == 0
                self._sending = mode == 0
                if self._sending:
                    self._run_timer(t_ns)
                else:
                    self.next_ns = None
            case TactileSetup():
                self._obey_tactile_setup(command, t_ns)
            case TactileSetup2(shift, shifts, no_load, flags, enabled):
                self.shift[:] = shift & 0xF
                self._shift_three, self._shift_all = shifts & 0xF, shifts >> 4
                self.no_load = no_load
                self._compensates = bool(flags & 8)
                self.skin_type = flags & 3
                self.triangles[:] = enabled >> np.arange(TRIANGLES) & 1
                self.version += 1
                self._calibrate_at_tick = True
                self._sending = True
                self._run_timer(t_ns)
            case GetFirmwareVersion(major, minor):
                same = (major, minor) == self.identity.protocol
                return [self._firmware_version(compatible=same)]
        return []

    def _obey_tactile_setup(self, command: TactileSetup, t_ns: int) -> None:
        stages = command.mode >> 4
        self._stages = StageMap(stages) if stages in set(StageMap) else self._stages
        decimation = (command.decimation & 0xF) - 1
        if 0 <= decimation < len(POWER_CONTROLS[self._stages]):
            self._power_control = POWER_CONTROLS[self._stages][decimation]
            self._period(TIMERS[self._stages][decimation])
        if command.timer_flag & 0xF == 3:
            self._period(command.timer)
        self.cdc_offset[:] = command.cdc_offset
        self._to_update[:] = True
        self._calibrate_at_tick = True
        self._starts_after_calibration = False
        self._sending = True
        self._run_timer(t_ns)

    def _obey_management(self, command: Message, t_ns: int, *, addressed: bool) -> list[Message]:
        match command:
            case Discover():
                return [self._discovered()]
            case Ping() if addressed:
                return [PingAnswer()]
            case EnterBootloader():
                if addressed:
                    self._restart_ns = t_ns + round(BOOTLOADER_S * 1e9)
                return [ResetAnswer()]
            case GetAdditionalInfo() if addressed:
                return self._additional_info()
            case SetAdditionalInfo(index, text) if addressed and index < len(self.info):
                self.info[index] = text
        return []

    def _configure_all(self) -> None:
        self.chips.configure(
            range(4 * CHIPS_PER_LINE), self._stages, int(self.cdc_offset[0]), self._power_control
        )
