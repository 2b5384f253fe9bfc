"""The emulated bus by its short name; the bus itself is `emulator.chips.i2c`."""

from emulator.chips.i2c import EmulatedSMBus

__all__ = ["EmulatedSMBus"]
