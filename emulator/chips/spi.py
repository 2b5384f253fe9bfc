"""The AD7147 on SPI (the part without -1): its framing behind spidev's interface.

A frame is what passes while the chip is selected: a command word, 0b11100 in its upper five bits,
then read or write, then a register's address in ten bits; then words, most significant bits first.
The die is that of the AD7147-1. Sources: drivers/input/misc/ad714x-spi.c of Linux, AD7142 data
sheet (serial interface).
"""

from collections.abc import Sequence

from emulator.chips.i2c_wire import Chip

COMMAND = 0b11100 << 11
COMMAND_MASK = 0b11111 << 11
READ = 1 << 10
ADDRESS = READ - 1
#: What is read while the chip drives nothing: its output is three-state, and pulled up here [D].
FLOATING = 0xFF


class EmulatedSpi:
    """What `spidev.SpiDev` is to a driver, with a chip instead of a device file.

    Args:
        chip: what is selected.
    """

    def __init__(self, chip: Chip) -> None:
        self._chip = chip

    def xfer2(self, values: Sequence[int]) -> list[int]:
        """One frame: as many bytes are read as are sent.

        A frame whose command is none, or that ends within it, changes nothing.
        """
        sent = bytes(values)
        floating = [FLOATING] * len(sent)
        command = int.from_bytes(sent[:2])
        if len(sent) < 2 or command & COMMAND_MASK != COMMAND:
            return floating
        address = (command & ADDRESS).to_bytes(2)
        if not command & READ:
            self._chip.write(address + sent[2:])
            return floating
        self._chip.write(address)
        return [*floating[:2], *self._chip.read(len(sent) - 2)]

    def writebytes(self, values: Sequence[int]) -> None:
        """One frame of which nothing is read."""
        self.xfer2(values)
