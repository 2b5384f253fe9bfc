"""Twenty faults planted into the daemon, and how many seeds `skin simulate` needs to find each.

    python -m tests.evaluation.simulate.mutants [--seeds 200] [--seconds 60] [--only NAME ...]

Each mutant is a copy of `skin_host` with one line changed, run by itself. A seed finds it if a
promise is broken that the daemon as it is keeps with that seed.
"""

import argparse
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[3]
SMALL = Path(__file__).with_name("small.toml")


class Mutant(NamedTuple):
    """One planted fault.

    Attributes:
        name: of it.
        file: in `skin_host`.
        line: what stands there, once.
        planted: what stands there instead.
    """

    name: str
    file: str
    line: str
    planted: str


MUTANTS = [
    Mutant(
        "a full queue's loss is not counted",
        "mqtt/outbox.py",
        "        self.counters.touches_dropped += 1\n        if not self._overflowing:",
        "        if not self._overflowing:",
    ),
    Mutant(
        "what is retained is not sent again to a broker that forgot",
        "mqtt/outbox.py",
        "self.pending = {topic: None for topic in self.retained if not self._is_given_up(topic)}",
        "self.pending = dict(self.pending)",
    ),
    Mutant(
        "events in flight are dropped with a connection",
        "mqtt/outbox.py",
        "kept = [event for event in self.events if event.is_touch]",
        "kept = list[Event]()",
    ),
    Mutant(
        "an event that arrived is sent once more",
        "mqtt/outbox.py",
        "event = self.events.popleft()\n        self.counters.touches_sent += event.is_touch",
        "event = self.events[0]\n        self.counters.touches_sent += event.is_touch\n"
        "        if event.payload[-2:] != b'  ': self.events[0] = "
        "event._replace(payload=event.payload + b'  ')\n        else: self.events.popleft()",
    ),
    Mutant(
        "every event has the same count",
        "mqtt/outbox.py",
        "count = self._counts[topic] = self._counts.get(topic, 0) + 1",
        "count = self._counts[topic] = 1",
    ),
    Mutant(
        "a part without a valid taxel is OFF",
        "mqtt/contact.py",
        '        if not feels.any():\n            return "UNKNOWN"',
        '        if not feels.any():\n            return "OFF"',
    ),
    Mutant(
        "a change of contact is published once only",
        "mqtt/publisher.py",
        "if self._outbox.retained.get(topic) != payload:",
        "if len(self._outbox.retained.get(topic, b'')) < 4:",
    ),
    Mutant(
        "frames are not counted",
        "bus/assembler.py",
        "        self.counters.frames += len(batch)\n",
        "",
    ),
    Mutant(
        "halves are paired across a pause",
        "bus/assembler.py",
        "            or t_ns - state.last_ns > state.pause_ns\n"
        "            or t_ns - state.first_ns > state.close_ns",
        "            or t_ns - state.last_ns > 1000 * state.pause_ns",
    ),
    Mutant(
        "a board is never silent",
        "bus/ledger.py",
        "return quiet_ns > int(self._silent_after_ns[row])",
        "return quiet_ns > 1000 * int(self._silent_after_ns[row])",
    ),
    Mutant(
        "a new zero is trusted whatever touched",
        "bus/boards.py",
        "self._zeroed(record.index, believed)",
        "self._zeroed(record.index, False)",
    ),
    Mutant(
        "a board that was reset is only told to start",
        "bus/boards.py",
        "            await self._set_up(record)\n\n    async def stop",
        "            await self._port.send([command_frame(SetTxMode(TxMode.START), address)])\n\n"
        "    async def stop",
    ),
    Mutant(
        "taxels that a new zero made unknown stay valid",
        "processing/validity.py",
        "valid = received if veto is None else received & ~veto",
        "valid = received",
    ),
    Mutant(
        "a chip that does not answer is believed",
        "processing/validity.py",
        "here = here & (ledger.error[row] == 0) & ~lifted(raw, far)",
        "here = here & ~lifted(raw, far)",
    ),
    Mutant(
        "what did not come stays as it was",
        "processing/intake.py",
        "                state.present[feed.target] = False\n"
        "                state.received[feed.target] = False\n            feed.fresh",
        "                pass\n            feed.fresh",
    ),
    Mutant(
        "touches go on when the daemon ends",
        "processing/contacts.py",
        'return [self._closed(name, seq, t_ns, "stopped") for name in list(self._contacts)]',
        "return []",
    ),
    Mutant(
        "identities are used again",
        "processing/contacts.py",
        "                self._next_id += 1\n",
        "                self._next_id = self._next_id % 3 + 1\n",
    ),
    Mutant(
        "a file takes its name before its bytes are on the disk",
        "files.py",
        "        disk.sync(temporary)\n",
        "",
    ),
    Mutant(
        "a period that is off is not told",
        "health/diagnosis.py",
        "PERIOD_SHARE = 0.05",
        "PERIOD_SHARE = 5.0",
    ),
    Mutant(
        "single frames' losses are told of any bus",
        "health/diagnosis.py",
        'if recent["halves"] >= FEW_HALVES:',
        'if recent["frames_hz"] > 0 and recent["halves"] >= 0:',
    ),
]

_RUN = """
import logging, sys
from pathlib import Path
from skin_host.cli.common import load_skin
from skin_host.evaluation.simulate.run import simulate
logging.disable(logging.CRITICAL)
config, first, seeds, seconds = Path(sys.argv[1]), *map(int, sys.argv[2:5])
settings, layout = load_skin(config)
for seed in range(first, first + seeds):
    try:
        broken = simulate(settings, layout, config, seed, seconds).broken
    except Exception as error:
        broken = f"{type(error).__name__}: {error}"
    print(seed, broken or "", flush=True)
"""


def plant(mutant: Mutant, folder: Path) -> None:
    """Write a daemon with the fault to a folder."""
    shutil.copytree(ROOT / "skin_host", folder / "skin_host")
    shutil.copytree(ROOT / "emulator", folder / "emulator")
    shutil.copytree(ROOT / "config", folder / "config")
    path = folder / "skin_host" / mutant.file
    source = path.read_text()
    assert source.count(mutant.line) == 1, f"{mutant.name}: not once in {mutant.file}"
    path.write_text(source.replace(mutant.line, mutant.planted))


def find(mutant: Mutant, seeds: list[int], seconds: int) -> tuple[int, str] | None:
    """The place in `seeds` of the first that finds a mutant, from 1, and what it broke."""
    with tempfile.TemporaryDirectory() as name:
        plant(mutant, Path(name))
        for number, seed in enumerate(seeds, 1):
            said = subprocess.run(
                [sys.executable, "-c", _RUN, str(SMALL), str(seed), "1", str(seconds)],
                cwd=name,
                capture_output=True,
                text=True,
                check=False,
            )
            last = (said.stdout.strip() or said.stderr.strip()).splitlines()[-1:]
            outcome = last[0].partition(" ")[2] if last else "it ended"
            if outcome:
                return number, outcome
    return None


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, default=200)
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--seconds", type=int, default=30)
    parser.add_argument("--only", nargs="*", default=[])
    arguments = parser.parse_args()
    chosen = [m for m in MUTANTS if not arguments.only or any(w in m.name for w in arguments.only)]
    asked = [
        sys.executable,
        "-c",
        _RUN,
        str(SMALL),
        *map(str, (arguments.first, arguments.seeds, arguments.seconds)),
    ]
    seeds = []
    with subprocess.Popen(asked, cwd=ROOT, stdout=subprocess.PIPE, text=True) as plain:
        assert plain.stdout is not None
        for line in plain.stdout:
            seed, _, broken = line.strip().partition(" ")
            if broken:
                print(f"seed {seed} is left out: {broken}", flush=True)
            else:
                seeds.append(int(seed))
    found = 0
    for mutant in chosen:
        outcome = find(mutant, seeds, arguments.seconds)
        found += outcome is not None
        said = "not found" if outcome is None else f"seed {outcome[0]}: {outcome[1][:110]}"
        print(f"{mutant.name}: {said}", flush=True)
    print(f"{found} of {len(chosen)} found within {len(seeds)} seeds")
    return 0


if __name__ == "__main__":
    sys.exit(main())
