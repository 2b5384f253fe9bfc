"""The AD7147 by its short name; the chip itself is `emulator.chips.ad7147`."""

from emulator.chips.ad7147 import AD7147

__all__ = ["AD7147"]
