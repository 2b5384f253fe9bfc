"""The entries of `targets`, guided by coverage: new ways through our code are followed.

python -m tests.fuzz.guided SECONDS
"""

import asyncio
import logging
import sys
from pathlib import Path

import atheris

# Only our own code is watched: watching all that it imports takes minutes.
with atheris.instrument_imports(include=["skin_host"]):
    from tests.fuzz import targets

LONGEST_BYTES = 4096


def _frames(data: bytes) -> None:
    buses = targets.Buses()
    buses.feed(data)
    buses.look()


def _command(data: bytes) -> None:
    name = targets.COMMANDS[data[0] % len(targets.COMMANDS)]
    asyncio.run(targets.Commands().take(name, data[1:]))


ENTRIES = (
    targets.configuration,
    targets.calibration_file,
    targets.state_file,
    _frames,
    _command,
)


def one(data: bytes) -> None:
    """The first byte chooses the entry."""
    if len(data) > 1:
        ENTRIES[data[0] % len(ENTRIES)](data[1:])


def seed(folder: Path) -> None:
    """Something sound of each kind to begin with."""
    requests = (b'{"seconds":1.5,"part":"left_hand"}', b'{"set":{"votes_of_3":3}}')
    seeds = [
        b"\0" + targets.CONFIG.read_bytes(),
        b'\2{"schema":"skin.state/1"}',
        b"\3" + bytes(280),
    ]
    seeds += [bytes([4, n]) + one for n in range(len(targets.COMMANDS)) for one in requests]
    for number, data in enumerate(seeds):
        (folder / str(number)).write_bytes(data)


if __name__ == "__main__":
    logging.disable(logging.CRITICAL)
    corpus = Path("corpus")
    corpus.mkdir(exist_ok=True)
    seed(corpus)
    limits = [f"-max_total_time={sys.argv[1]}", f"-max_len={LONGEST_BYTES}", "-len_control=0"]
    atheris.Setup([sys.argv[0], *limits, str(corpus)], one)
    atheris.Fuzz()
