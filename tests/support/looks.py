"""Two chips live through the same; one is looked at, the other is not. Do they differ?

    python -m tests.support.looks [RUNS]

Draws register settings, capacitances, commands and times of looks, 10 000 times unless told
otherwise, and prints the runs in which looks changed something.
"""

import sys

import numpy as np

from emulator.chips import ad7147_map as reg
from emulator.chips.ad7147 import AD7147

#: Reading these clears them: that is no look.
STATUS = range(reg.STAGE_LOW_INT_STATUS, reg.STAGE_COMPLETE_INT_STATUS + 1)


def put(chip: AD7147, address: int, *words: int) -> None:
    chip.write(b"".join(int(word).to_bytes(2, "big") for word in (address, *words)))


def words(chip: AD7147, address: int, n: int) -> list[int]:
    chip.write(address.to_bytes(2, "big"))
    data = chip.read(2 * n)
    return [int.from_bytes(data[i : i + 2], "big") for i in range(0, 2 * n, 2)]


def look(chip: AD7147, rng: np.random.Generator) -> None:
    """Look at something that reading does not change."""
    match rng.integers(5):
        case 0:
            words(chip, reg.CDC_RESULT, 12)
        case 1:
            words(chip, reg.PROXIMITY_STATUS, 1)
        case 2:
            words(chip, reg.BANK_3, reg.RESULT_WORDS)
        case 3:
            assert chip.interrupt in (False, True)
        case 4:
            words(chip, int(rng.integers(reg.BANK_2, reg.END_OF_MAP)), 3)


def set_up(chips: list[AD7147], rng: np.random.Generator) -> None:
    """Drawn settings that drivers could choose, icub's pinned ambient among them."""
    icub = rng.random() < 0.3
    stages = int(rng.choice([1, 4, 8, 12]))
    mode = 0 if icub else int(rng.choice([0, 0, 2]))
    decimation = int(rng.integers(4))
    offsets = [int(rng.integers(50, 1650)) for _ in range(4)]
    bank_2 = []
    for stage in range(12):
        low = 0xFFFF & ~(1 << 2 * stage) if stage < 7 else 0xFFFF
        high = 0x1FFF & ~(1 << 2 * (stage - 7)) if stage >= 7 else 0x1FFF
        bank_2 += [low, high, 0x2000, int(rng.choice([0x2626, 0x4848])), *offsets]
    controls = [
        mode | (stages - 1) << 4 | decimation << 8 | (0x1000 if rng.random() < 0.05 else 0),
        0,
        0 if icub else int(rng.integers(1 << 14)),
        0 if icub else int(rng.choice([0, 4, 25, 100, 255])),
        0 if icub else int(rng.integers(64)) << 10 | int(rng.choice([0, 5, 50, 400])),
        0 if icub else int(rng.choice([0, 0xFFF])),
        0 if icub else int(rng.choice([0, 0xFFF])),
        int(rng.choice([0, 0x800])),
    ]
    calibrated = int(rng.choice([0xFFF, 0xFFF, 0x0F0])) | int(rng.integers(16)) << 12
    for chip in chips:
        put(chip, reg.BANK_2, *bank_2)
        put(chip, reg.PWR_CONTROL, *controls)
        put(chip, reg.STAGE_CAL_EN, calibrated)


def change(chips: list[AD7147], rng: np.random.Generator) -> None:
    """Something happens to both chips: mostly a press, now and then a command."""
    kind = rng.random()
    if kind < 0.8:
        cin = int(rng.integers(12))
        value = 10240.0 + 0.36 * float(rng.choice([0, 0, 3, 40, 300, 1000, 2000]))
        for chip in chips:
            chip.set_capacitance_ff(cin, value)
    elif kind < 0.9:
        # A press as mechanics makes it: in many steps, of which nobody sees any.
        values = 10240.0 + rng.normal(0.0, 0.36 * 100, 12)
        for _ in range(int(rng.integers(1, 40))):
            values = values + rng.normal(0.0, 0.36 * 50, 12)
            pause_s = float(rng.choice([0.0, 0.001, 0.005, 0.03]))
            for chip in chips:
                chip.set_capacitances_ff(values)
                chip.advance(pause_s)
    else:
        address, word = (
            (reg.AMB_COMP_CTRL0, 0x3233 | reg.FORCED_CAL),
            (reg.AMB_COMP_CTRL0, 0x3233 | reg.CONV_RESET),
            (reg.PWR_CONTROL, 0x02B0),
            (reg.PWR_CONTROL, 0x02B1),
            (reg.PWR_CONTROL, reg.SW_RESET),
            (reg.BANK_2 + 3, 0x1313),
        )[rng.integers(6)]
        for chip in chips:
            put(chip, address, word)


def one_run(seed: int) -> None:
    """Two chips live through the same; one is looked at, the other not until the end."""
    rng = np.random.default_rng(seed)
    chips = [AD7147(np.random.default_rng(seed)) for _ in range(2)]
    for chip in chips:
        chip.set_capacitances_ff(np.full(12, 10240.0))
    set_up(chips, rng)
    watched, alone = chips
    looks = np.random.default_rng(seed + 1)
    for _ in range(int(rng.integers(2, 12))):
        duration_ns = int(10 ** rng.uniform(6, 10))
        cuts = np.sort(looks.integers(0, duration_ns, looks.integers(0, 12)))
        for piece_ns in np.diff([0, *cuts, duration_ns]):
            watched.advance(int(piece_ns) * 1e-9)
            look(watched, looks)
        alone.advance(duration_ns * 1e-9)
        change(chips, rng)
    for chip in chips:
        chip.advance(0.5)
    assert watched.interrupt == alone.interrupt, f"seed {seed}"
    assert watched.int_level == alone.int_level, f"seed {seed}"
    seen = [words(chip, 0, reg.END_OF_MAP) for chip in chips]
    different = [hex(at) for at, pair in enumerate(zip(*seen, strict=True)) if len(set(pair)) > 1]
    assert not different, f"seed {seed}: registers {different}"


def main(runs: int) -> int:
    """The exit status: 1 if looks changed something in any of the runs."""
    changed = []
    for seed in range(runs):
        try:
            one_run(seed)
        except AssertionError as difference:
            changed.append(str(difference))
    print(*changed, f"looks change something in {len(changed)} of {runs} runs drawn", sep="\n")  # noqa: T201
    return bool(changed)


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]) if len(sys.argv) > 1 else 10_000))
