"""Register map of the AD7147: addresses, fields, reset values, and what the set-up words mean.

Sources: the AD7147 data sheet where its pages were at hand (Table 10 for timing), the
register lists of Analog Devices' own drivers, and the drivers that run on real skins. Facts
known from memory of the data sheet only are marked [M]; choices of this model, [D].
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

N_STAGES = 12
N_CINS = 13

# Bank 1: set-up, status, results.
PWR_CONTROL = 0x000
STAGE_CAL_EN = 0x001
AMB_COMP_CTRL0 = 0x002
AMB_COMP_CTRL1 = 0x003
AMB_COMP_CTRL2 = 0x004
STAGE_LOW_INT_ENABLE = 0x005
STAGE_HIGH_INT_ENABLE = 0x006
STAGE_COMPLETE_INT_ENABLE = 0x007
STAGE_LOW_INT_STATUS = 0x008
STAGE_HIGH_INT_STATUS = 0x009
STAGE_COMPLETE_INT_STATUS = 0x00A
CDC_RESULT = 0x00B
DEVICE_ID = 0x017
CURRENT_LOW = 0x040
CURRENT_HIGH = 0x041
PROXIMITY_STATUS = 0x042

# Bank 2: eight words a stage.
BANK_2 = 0x080
STAGE_WORDS = 8
OFFSET_LOW, OFFSET_HIGH, OFFSET_HIGH_CLAMP, OFFSET_LOW_CLAMP = 4, 5, 6, 7

# Bank 3: 36 words a stage, plain RAM that the chip also writes.
BANK_3 = 0x0E0
RESULT_WORDS = 0x24
CONV_DATA, SF_AMBIENT, FF_AVG, HIGH_THRESHOLD, LOW_THRESHOLD = 0x00, 0x11, 0x12, 0x1A, 0x21
UNUSED_WORD = 0x23

END_OF_MAP = 0x290

#: 0x147 is the part, the low nibble the revision; the only value seen on silicon.
DEVICE_ID_VALUE = 0x1471

SW_RESET = 0x0400
EXT_SOURCE = 0x1000
CONV_RESET = 0x8000
FORCED_CAL = 0x4000

#: Values after power-up and SW_RESET. 0x002-0x004 were read on silicon; the zeros are [M].
RESET_VALUES = {
    AMB_COMP_CTRL0: 0x0FF0,
    AMB_COMP_CTRL1: 0x0164,
    AMB_COMP_CTRL2: 0xFFFF,
    DEVICE_ID: DEVICE_ID_VALUE,
}

#: Writable bits of Bank 1; addresses that are not listed are read-only or do not exist.
#: Self-clearing bits (SW_RESET, CONV_RESET) and reserved bits read back 0.
BANK_1_WRITABLE = {
    PWR_CONTROL: 0xFFFF & ~0x2000 & ~SW_RESET,
    STAGE_CAL_EN: 0xFFFF,
    AMB_COMP_CTRL0: 0xFFFF & ~CONV_RESET,
    AMB_COMP_CTRL1: 0xFFFF,
    AMB_COMP_CTRL2: 0xFFFF,
    STAGE_LOW_INT_ENABLE: 0xFFFF,
    STAGE_HIGH_INT_ENABLE: 0x0FFF,
    STAGE_COMPLETE_INT_ENABLE: 0x1FFF,
}

#: One step of an AFE offset DAC (fF), 63 steps in all.
AFE_STEP_FF = 320.0
MID_SCALE = 32768
FULL_SCALE = 65535

#: rms noise in codes by the DECIMATION field (256, 128, 64, 64). [M]
NOISE_CODES_RMS = (0.5, 0.8, 1.1, 1.1)

#: Time of one conversion by the DECIMATION field: three filter settlings at 250 kHz (Table 10).
STAGE_NS = (3_072_000, 1_536_000, 768_000, 768_000)
LOW_POWER_DELAY_NS = (200_000_000, 400_000_000, 600_000_000, 800_000_000)

FULL_POWER, SHUTDOWN, LOW_POWER = 0, 1, 2

Registers = NDArray[np.uint16]
Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class PowerControl:
    """Fields of PWR_CONTROL. `mode` is FULL_POWER, SHUTDOWN or LOW_POWER."""

    mode: int
    n_stages: int
    decimation: int
    low_power_delay_ns: int
    excited: bool = True

    @classmethod
    def of(cls, word: int) -> "PowerControl":
        """Decode `word`. Mode 3 is shutdown again; more than 12 stages are 12 [D]."""
        mode = word & 3
        return cls(
            mode=SHUTDOWN if mode == 3 else mode,
            n_stages=min(((word >> 4) & 0xF) + 1, N_STAGES),
            decimation=(word >> 8) & 3,
            low_power_delay_ns=LOW_POWER_DELAY_NS[(word >> 2) & 3],
            excited=not word & EXT_SOURCE,
        )

    @property
    def stage_ns(self) -> int:
        """Time of one conversion."""
        return STAGE_NS[self.decimation]

    @property
    def sequence_ns(self) -> int:
        """Time of one pass over all stages."""
        return self.n_stages * self.stage_ns


def reset_registers() -> Registers:
    """The whole map after power-up with RAM at zero: big-endian uint16[0x290]."""
    registers = np.zeros(END_OF_MAP, ">u2")
    for address, value in RESET_VALUES.items():
        registers[address] = value
    return registers


def writable_mask(address: int) -> int:
    """Which bits of the word at `address` (below END_OF_MAP) a write can change.

    Banks 2 and 3 are RAM and keep all 16 bits, reserved ones too: drivers write ones there
    and compare the read-back [D].
    """
    if address < BANK_2:
        return BANK_1_WRITABLE.get(address, 0)
    if address >= BANK_3 and (address - BANK_3) % RESULT_WORDS == UNUSED_WORD:
        return 0
    return 0xFFFF


def decode_stages(bank_2: Registers) -> tuple[Floats, Floats]:
    """Read the stages' connections and offsets out of Bank 2, uint16[12, 8].

    Returns:
        weights float64[12, 13]: +1 where a CIN is on the positive converter input, -1 on the
            negative one, 0 where it floats or lies on BIAS. Several CINs on a side add up.
        offset_ff float64[12]: what the two AFE DACs take off the positive input (fF). A DAC
            with its SWAP bit works on the other input, a disabled one on none.

    SE_CONNECTION_SETUP (single-ended or differential) only determines how the unused input is
    terminated, so it does not enter [D].
    """
    words = bank_2.astype(np.int64)
    low = (words[:, :1] >> (2 * np.arange(7))) & 3
    high = (words[:, 1:2] >> (2 * np.arange(6))) & 3
    connection = np.concatenate([low, high], axis=1)
    weights = np.select([connection == 2, connection == 1], [1.0, -1.0], 0.0)

    disable, afe = words[:, 1], words[:, 2]
    negative = (afe & 0x3F) * (1 - (disable >> 14 & 1))
    positive = (afe >> 8 & 0x3F) * (1 - (disable >> 15 & 1))
    negative_side = np.where(afe >> 7 & 1, 1, -1)
    positive_side = np.where(afe >> 15 & 1, -1, 1)
    return weights, AFE_STEP_FF * (positive * positive_side + negative * negative_side)
