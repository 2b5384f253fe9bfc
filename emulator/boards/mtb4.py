"""MTB4 and MTB4C: STM32 boards, one event loop, 32-bit arithmetic, silent until started.

Sources: embot_app_application_theSkin.cpp, ..._theCANparserSkin.cpp, ..._theCANparserBasic.cpp,
embot_prot_can.cpp, and AD7147.c of the board, icub-firmware.
"""

from typing import ClassVar

import numpy as np

from emulator.boards.arithmetic import transmit_32
from emulator.boards.board import BOOTLOADER_S, NS_PER_MS, Frame, Identity, Mtb
from emulator.boards.chip_access import SLOTS, Chips, StageMap
from skin_host.bus.answers import TimeOfLife, answer_frame
from skin_host.bus.commands import (
    BoardType,
    Discover,
    EnterBootloader,
    GetAdditionalInfo,
    GetFirmwareVersion,
    GetTimeOfLife,
    Message,
    SetAdditionalInfo,
    SetBoardAddress,
    SetBoardConfig,
    SetCanAddress,
    SetTriangleConfig,
    SetTxMode,
    TactileSetup,
    parse_command,
)
from skin_host.bus.wire import BROADCAST_ADDRESS, TRIANGLES, MessageClass

POWER_CONTROL = 0x00B0
DEFAULT_CDC_OFFSET = 0x2200
NO_ACKS_TO_CALIBRATE = 5
RANDOM_ADDRESS = 0xFF
SKIN_TYPES = frozenset({0, 1, 2, 3, 7, 8})
PLAIN_SLOTS = tuple(range(TRIANGLES))
#: Where the triangles of an ergoCub hand sit; slot 16 is the first chip of the fifth line.
ERGO_HAND_SLOTS = (0, 4, 8, 12, 16, 9, 10, 11, 13, 15, 1, 2, 3, 5, 6, 7)


class Mtb4(Mtb):
    """The MTB4. Its chips are set up at the first skin command after power-up.

    Command 50 stops the stream and takes the baseline at once, before the chips have
    converted with a new CDC offset: then untouched values come out wrong until the command
    is sent again (icub-firmware, open threads 671 and 678).
    """

    identity: ClassVar[Identity] = Identity(BoardType.MTB4, (1, 25, 0), (2, 0))
    arithmetic = staticmethod(transmit_32)

    def __init__(self, address: int, chips: Chips, random: np.random.Generator) -> None:
        self._random = random
        super().__init__(address, chips)

    def reset(self, t_ns: int) -> None:
        """As after power-up: not even the chips are set up."""
        self._defaults(period_ms=50, no_load=245)
        self.start_ns = t_ns
        self._in_bootloader_until_ns: int | None = None
        self._chips_ready = False
        self._calibrate_at_tick = False
        #: Where command 50 puts its settings: the hand's map is in force from its first tick on.
        self._order = PLAIN_SLOTS

    @property
    def _slots(self) -> tuple[int, ...]:
        return ERGO_HAND_SLOTS if self.skin_type == 3 else PLAIN_SLOTS

    def slot(self, triangle: int) -> int:
        """An ergoCub hand has a map of its own."""
        return self._slots[triangle]

    @property
    def sends_raw(self) -> bool:
        """Skin type 7: the low byte of every raw word."""
        return self.skin_type == 7

    def advance(self, t_ns: int) -> bool:
        """A tick of the stream's timer, if it has come."""
        if self._in_bootloader_until_ns is not None and t_ns >= self._in_bootloader_until_ns:
            self.reset(t_ns)
        if self.next_ns is None or t_ns < self.next_ns:
            return False
        self.next_ns += self.period_ns
        if self.next_ns <= t_ns:
            self.next_ns = t_ns + self.period_ns
        self._order = self._slots
        if self._calibrate_at_tick:
            self._calibrate_at_tick = False
            self._take_baseline()
        return True

    @property
    def due_ns(self) -> int | None:
        """The next tick, or the end of the bootloader."""
        return self.next_ns if self.next_ns is not None else self._in_bootloader_until_ns

    def count_no_ack(self, triangles: int) -> None:
        """Good readings never reset the count; the fifth bad one re-baselines the board."""
        self.no_acks += triangles
        if self.no_acks >= NO_ACKS_TO_CALIBRATE:
            self.no_acks %= NO_ACKS_TO_CALIBRATE
            self._calibrate_at_tick = True

    def handle(self, can_id: int, data: bytes, t_ns: int) -> list[Frame]:
        """Take a command for this address or for all, from anyone; bytes not sent are 0."""
        receiver = can_id & 0xF
        message_class = can_id >> 8
        commanding = {MessageClass.ANALOG_COMMAND, MessageClass.MANAGEMENT}
        if receiver not in {self.address, BROADCAST_ADDRESS} or message_class not in commanding:
            return []
        if message_class == MessageClass.ANALOG_COMMAND and data:
            # The parser masks the command byte of polling classes.
            data = bytes([data[0] & 0x7F]) + data[1:]
        parsed = parse_command(can_id & 0x70F, data.ljust(8, b"\0"))
        if parsed is None:
            return []
        address = self.address
        sender = can_id >> 4 & 0xF
        return [
            (answer_id | sender, payload)
            for answer_id, payload in (
                answer_frame(answer, address) for answer in self._obey(parsed[1], t_ns)
            )
        ]

    def _obey(self, command: Message, t_ns: int) -> list[Message]:
        if self._in_bootloader_until_ns is not None:
            return self._obey_in_bootloader(command, t_ns)
        match command:
            case Discover():
                return [self._discovered()]
            case EnterBootloader():
                self.next_ns = None
                self._in_bootloader_until_ns = t_ns + round(BOOTLOADER_S * 1e9)
            case SetCanAddress(address, forbidden):
                self._set_address(address, forbidden)
            case SetBoardAddress(address):
                self._set_address(address, 0)
            case GetAdditionalInfo():
                return self._additional_info()
            case SetAdditionalInfo(index, text) if index < len(self.info):
                self.info[index] = text
            case GetTimeOfLife():
                life_us = (t_ns - self.start_ns) // 1000
                return [TimeOfLife(life_us.to_bytes(7, "little"))]
            case GetFirmwareVersion(major, minor):
                own = self.identity.protocol
                return [self._firmware_version(compatible=own[0] == major and own[1] >= minor)]
            case SetBoardConfig() | SetTriangleConfig() | SetTxMode() | TactileSetup():
                self._set_up_chips()
                self._obey_skin(command, t_ns)
        return []

    def _obey_skin(self, command: Message, t_ns: int) -> None:
        match command:
            case SetBoardConfig(skin_type, period_ms, no_load):
                self.skin_type = skin_type if skin_type in SKIN_TYPES else 2
                self.period_ns = period_ms * NS_PER_MS
                self.no_load = no_load
                self._set_triangles(0, TRIANGLES - 1, enabled=False)
                if self.next_ns is not None:
                    self._start(t_ns)
            case SetTriangleConfig(first, last, shift, flags, cdc_offset):
                if first > last or last >= TRIANGLES:
                    return
                self._set_triangles(first, last, enabled=bool(flags & 1))
                for triangle in range(first, last + 1):
                    self._configure(self._order[triangle], shift, cdc_offset)
                self.next_ns = None
                self._take_baseline()
            case SetTxMode(mode):
                if mode == 0:
                    self._start(t_ns)
                else:
                    self.next_ns = None
            case TactileSetup():
                # All arguments are ignored: the board's defaults, 40 ms, baseline, start. Triangles
                # keep their shift, and chips get the offset if they have another.
                shifts, offsets = self.shift, self.cdc_offset
                self._defaults(period_ms=40, no_load=245)
                self.shift, self.cdc_offset = shifts, offsets
                for triangle in range(TRIANGLES):
                    self._configure(triangle, int(shifts[triangle]), DEFAULT_CDC_OFFSET)
                self._take_baseline()
                self._start(t_ns)

    def _start(self, t_ns: int) -> None:
        """Restart the timer; one of period 0 never ticks."""
        self.next_ns = t_ns + self.period_ns if self.period_ns else None

    def _set_up_chips(self) -> None:
        if self._chips_ready:
            return
        self._chips_ready = True
        self.chips.configure(range(SLOTS), StageMap.SINGLE, DEFAULT_CDC_OFFSET, POWER_CONTROL)
        self._take_baseline()

    def _configure(self, slot: int, shift: int, cdc_offset: int) -> None:
        # Shift and offset are taken whether the triangle is enabled or not.
        self.shift[slot] = min(shift, 16)
        if self.cdc_offset[slot] != cdc_offset:
            self.cdc_offset[slot] = cdc_offset
            self.chips.configure([slot], StageMap.SINGLE, cdc_offset, POWER_CONTROL)

    def _set_address(self, address: int, forbidden: int) -> None:
        if address == RANDOM_ADDRESS:
            allowed = [free for free in range(1, 15) if not forbidden >> free & 1]
            if not allowed:
                return
            address = int(self._random.choice(allowed))
        if address not in {0, BROADCAST_ADDRESS} and address < BROADCAST_ADDRESS:
            self.address = address
            self.version += 1


class Mtb4c(Mtb4):
    """The MTB4C: the same skin application under another name."""

    identity: ClassVar[Identity] = Identity(BoardType.MTB4C, (2, 4, 0), (2, 0))
