"""Long fuzzing: mutated bytes by the million, at the speed of the code.

python -m tests.fuzz.bulk --frames 1000000 --configurations 100000 --commands 100000
"""

import argparse
import asyncio
import json
import logging
import random
import sys
import time

import numpy as np

from skin_host.bus.wire import encode_sweep
from tests.fuzz import targets

BATCH = 200
#: One entry may take so long; more is a hang.
LIMIT_S = 5.0


def _frames(rng: np.random.Generator, count: int) -> int:
    """Real sweeps of the demo's boards with every kind of damage, and plain noise between."""
    buses = targets.Buses()
    while buses.frames < count:
        rows = rng.integers(0, 256, (BATCH, targets.FRAME_BYTES)).astype(np.uint8)
        if rng.random() < 0.8:
            triangles = np.arange(16)
            values = rng.integers(235, 245, (16, 12)).astype(np.uint8)
            status = np.where(rng.random(16) < 0.05, rng.integers(0, 65536, 16), 0)
            ids, data = encode_sweep(
                int(rng.choice([14, 13, 12])), triangles, values, status.astype(np.uint16)
            )
            rows = np.zeros((32, targets.FRAME_BYTES), np.uint8)
            rows[:, :4] = ids.astype("<u4").view(np.uint8).reshape(-1, 4)
            rows[:, 4] = 8
            rows[:, 5:13] = data
            rows[0, 13] = rng.integers(0, 60)
            for _ in range(int(rng.integers(0, 6))):
                rows[rng.integers(32), rng.integers(14)] ^= np.uint8(1 << rng.integers(8))
            rows = rows[rng.random(32) > 0.02]
            if rng.random() < 0.2:
                rng.shuffle(rows)
        began_s = time.monotonic()
        buses.feed(rows.tobytes())
        if rng.random() < 0.02:
            buses.look()
        assert time.monotonic() - began_s < LIMIT_S
    return buses.frames


def _mutated(random_: random.Random, data: bytes) -> bytes:
    text = bytearray(data)
    for _ in range(random_.randint(1, 8)):
        at = random_.randrange(len(text) + 1)
        match random_.randrange(4):
            case 0:
                text[at:at] = random_.randbytes(random_.randint(1, 4))
            case 1:
                del text[at : at + random_.randint(1, 12)]
            case 2 if at < len(text):
                text[at] = random_.choice(b'0123456789-+.eE"[]{}=,\n\\nulltrue')
            case _:
                other = random_.randrange(len(text) + 1)
                text[at:at] = text[other : other + random_.randint(1, 40)]
    return bytes(text)


def _configurations(random_: random.Random, count: int) -> int:
    seeds = [path.read_bytes() for path in sorted(targets.CONFIG.parent.glob("*.toml"))]
    small = min(seeds, key=len)
    for _ in range(count):
        data = _mutated(random_, small if random_.random() < 0.9 else random_.choice(seeds))
        began_s = time.monotonic()
        targets.configuration(data)
        assert time.monotonic() - began_s < LIMIT_S, data
    return count


async def _commands(random_: random.Random, count: int) -> int:
    commands = targets.Commands()
    seeds = [
        {"seconds": 1.5, "part": "left_hand", "id": "x"},
        {"board": "hand", "id": 3},
        {"set": {"margin_units": 2.0, "votes_of_3": 3}, "reset": False},
        {"file": "run.log", "seconds": 2.0, "max_bytes": 10000},
    ]
    for _ in range(count):
        payload = _mutated(random_, json.dumps(random_.choice(seeds)).encode())
        await commands.take(random_.choice(targets.COMMANDS), payload)
    return commands.answered


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--frames", type=int, default=20_000)
    parser.add_argument("--configurations", type=int, default=500)
    parser.add_argument("--commands", type=int, default=500)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    logging.disable(logging.CRITICAL)
    done = {
        "frames": _frames(np.random.default_rng(arguments.seed), arguments.frames),
        "configurations": _configurations(random.Random(arguments.seed), arguments.configurations),
        "commands": asyncio.run(_commands(random.Random(arguments.seed), arguments.commands)),
    }
    sys.stdout.write(json.dumps(done) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
