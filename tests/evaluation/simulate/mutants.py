"""Faults planted into the daemon, and how many seeds `skin simulate` needs to find each.

    python -m tests.evaluation.simulate.mutants [--seeds 200] [--results FILE] [--only NAME ...]

Each mutant is a copy of `skin_host` with one line changed, run by itself. A seed finds it if a
promise is broken that the daemon as it is keeps with that seed. FILE is appended to, a line a run:
the same command with the same sources continues there.
"""

import argparse
import logging
import os
import shutil
import sys
import tempfile
from collections.abc import Iterable, Iterator
from hashlib import blake2b
from pathlib import Path
from typing import NamedTuple

import aiomqtt  # noqa: F401  (loaded once, not by each run)
import can  # noqa: F401
import msgspec
import numpy as np  # noqa: F401

ROOT = Path(__file__).parents[3]
SMALL = Path(__file__).with_name("small.toml")
KASPAR = ROOT / "config" / "kaspar.toml"
DEMO = ROOT / "config" / "demo.toml"
FINGERTIPS = ROOT / "config" / "fingertips.toml"
PACKAGES = ("skin_host", "emulator", "config")


class Mutant(NamedTuple):
    """One planted fault.

    Attributes:
        name: of it.
        file: in `skin_host`.
        line: what stands there, once.
        planted: what stands there instead.
        config: the robot in which it is searched.
    """

    name: str
    file: str
    line: str
    planted: str
    config: Path = SMALL


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
        "self.pending = {topic: None for topic in topics if not self._is_given_up(topic)}",
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
        '        if not any_of(feels):\n            return "UNKNOWN"',
        '        if not any_of(feels):\n            return "OFF"',
    ),
    Mutant(
        "a change of contact is published once only",
        "mqtt/publisher.py",
        "if self._states_of_contact.get(part) != state:",
        "if len(self._states_of_contact.get(part, '')) < 4:",
    ),
    Mutant(
        "frames are not counted",
        "bus/assembler.py",
        "        self.counters.frames += n\n",
        "",
    ),
    Mutant(
        "halves are paired across a pause",
        "bus/periods.py",
        "        return min(paused_ns, first_ns + self.close_ns)",
        "        return first_ns + 1000 * self.pause_ns",
    ),
    Mutant(
        "a board is never silent",
        "bus/ledger.py",
        "return quiet_ns > int(self.silent_after_ns[row])",
        "return quiet_ns > 1000 * int(self.silent_after_ns[row])",
    ),
    Mutant(
        "a new zero is trusted whatever touched",
        "bus/boards.py",
        "self._zeroed(record.index, believed)",
        "self._zeroed(record.index, False)",
    ),
    Mutant(
        "boards are taken for zeroed when that is asked, not when their turn comes",
        "bus/boards.py",
        "            self._zeroed(record.index, believed)\n            yield from zeroing\n",
        "            yield from zeroing\n\n        self._zeroed(record.index, believed)\n",
        KASPAR,  # its boards share a bus
    ),
    Mutant(
        "taxels that a new zero made unknown stay valid",
        "processing/intake.py",
        "        if veto is None:\n            return masks\n",
        "        if True:\n            return masks\n",
    ),
    Mutant(
        "readings of two boards at one address are valid",
        "processing/intake.py",
        "        if row in ledger.twice:",
        "        if row in ():",
    ),
    Mutant(
        "a zero that a board took while nobody received it is not recognised",
        "processing/board_zeros.py",
        "        if zeroed:\n",
        "        if False:\n",
        DEMO,
    ),
    Mutant(
        "taxels of boards that are not zeroed yet are valid after a start",
        "processing/board_zeros.py",
        "        self.held = held if self.held is None else self.held | held\n",
        "",
    ),
    Mutant(
        "errors of chips are not noted",
        "bus/ledger.py",
        "self.error[row] = status_error(sweep.status)",
        "self.error[row] = 0",
    ),
    Mutant(
        "what did not come stays as it was",
        "processing/intake.py",
        "            raw[lost] = 0\n            present[lost] = received[lost] = False\n",
        "            pass\n",
    ),
    Mutant(
        "touches go on when the daemon ends",
        "processing/contacts/tracker.py",
        'return [self._closed(name, seq, t_ns, "stopped") for name in list(self._contacts)]',
        "return []",
    ),
    Mutant(
        "a touch that lasts is reported only when it changes",
        "processing/contacts/tracker.py",
        "silent_ns >= ALIVE_NS",
        "silent_ns >= 1000 * ALIVE_NS",
    ),
    Mutant(
        "identities are used again",
        "processing/contacts/tracker.py",
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
        "a period that is off is not reported",
        "health/diagnosis.py",
        "PERIOD_SHARE = 0.05",
        "PERIOD_SHARE = 5.0",
    ),
    Mutant(
        "single frames' losses are named for any bus",
        "health/diagnosis.py",
        'if recent["halves"] >= FEW_HALVES and not bus.get("lost_here"):',
        'if recent["frames_hz"] > 0 and recent["halves"] >= 0:',
    ),
    Mutant(
        "forces are in mN",
        "processing/contacts/tracker.py",
        "force_n=totals[number] * 1e-3,",
        "force_n=totals[number] * 1.0,",
    ),
    Mutant(
        "a contact is far away from its pads",
        "processing/contacts/tracker.py",
        "centroid = x / whole, y / whole, z / whole",
        "centroid = 9.0, 9.0, 9.0",
    ),
    Mutant(
        "normals point into the skin",
        "processing/contacts/tracker.py",
        "direction = weight @ self._normal[taxels]",
        "direction = -weight @ self._normal[taxels]",
    ),
    Mutant(
        "contacts have no area",
        "processing/contacts/tracker.py",
        "                area_mm2=found.area_mm2[number],\n",
        "                area_mm2=0.001,\n",
    ),
    Mutant(
        "the mean pressure is a sum in Pa",
        "processing/contacts/tracker.py",
        "mean_kpa=mean,",
        "mean_kpa=totals[number] * 1e3,",
    ),
    Mutant(
        "all pressures are a fifth",
        "processing/pipeline.py",
        "frame = self._frame(t_ns, raw, valid, pressure, touched, beyond, True)",
        "frame = self._frame(t_ns, raw, valid, 0.2 * pressure, touched, beyond, True)",
    ),
    Mutant(
        "touches need ten units more",
        "processing/touch.py",
        "margin = settings.margin_units - HALF_UNIT",
        "margin = 10.0 + settings.margin_units - HALF_UNIT",
    ),
    Mutant(
        "noise alone touches a pad once in 10^4 measurements",
        "processing/touch.py",
        "ODDS = 1e9\n",
        "ODDS = 1e4\n",
        DEMO,
    ),
    Mutant(
        "pads are taken for eight times as noisy",
        "processing/touch.py",
        "    margin = settings.margin_units",
        "    spread = 8.0 * spread\n    margin = settings.margin_units",
    ),
    Mutant(
        "fingertips press 1.3 times as hard",
        "fingertip/tip.py",
        "            force_n=normal_n,\n            sigma_m",
        "            force_n=1.3 * normal_n,\n            sigma_m",
        FINGERTIPS,
    ),
    Mutant(
        "forces on fingertips are 1.3 times as large",
        "fingertip/tip.py",
        "force_n = rounded(load[:3].tolist(), N_DECIMALS)",
        "force_n = rounded((1.3 * load[:3]).tolist(), N_DECIMALS)",
        FINGERTIPS,
    ),
    Mutant(
        "torques on fingertips are 1.3 times as large",
        "fingertip/tip.py",
        "torque_nm = rounded((1e-3 * load[3:]).tolist(), NM_DECIMALS)",
        "torque_nm = rounded((1.3e-3 * load[3:]).tolist(), NM_DECIMALS)",
        FINGERTIPS,
    ),
    Mutant(
        "shears of fingertips are 1.3 times as large",
        "fingertip/tip.py",
        "shear = rounded((load[:3] + normal_n * place.normal).tolist(), N_DECIMALS)",
        "shear = rounded((1.3 * (load[:3] + normal_n * place.normal)).tolist(), N_DECIMALS)",
        FINGERTIPS,
    ),
    Mutant(
        "a contact of a fingertip is 1.3 times as far from its origin",
        "fingertip/tip.py",
        "centroid_m=None if place is None else _vector(1e-3 * place.point_mm)",
        "centroid_m=None if place is None else _vector(1.3e-3 * place.point_mm)",
        FINGERTIPS,
    ),
    Mutant(
        "normals point into fingertips",
        "fingertip/tip.py",
        "            normal=None if place is None else _vector(place.normal),",
        "            normal=None if place is None else _vector(-place.normal),",
        FINGERTIPS,
    ),
    Mutant(
        "what slips presses 1.3 times as hard",
        "fingertip/tip.py",
        "            force_n=force_n,\n            shear_n=shear_n,",
        "            force_n=1.3 * force_n,\n            shear_n=shear_n,",
        FINGERTIPS,
    ),
    Mutant(
        "what slips is pulled twice as hard",
        "fingertip/tip.py",
        "            shear_n=shear_n,\n            shear_rate_n_s",
        "            shear_n=2.0 * shear_n,\n            shear_rate_n_s",
        FINGERTIPS,
    ),
    Mutant(
        "excesses are 1.3 times as large",
        "fingertip/tip.py",
        "t_ns=t_ns, part=self._name, force_n=force_n)",
        "t_ns=t_ns, part=self._name, force_n=1.3 * force_n)",
        FINGERTIPS,
    ),
]


def plant(mutant: Mutant, folder: Path) -> None:
    """Write a daemon with the fault to a folder."""
    for package in PACKAGES:
        shutil.copytree(ROOT / package, folder / package)
    path = folder / "skin_host" / mutant.file
    source = path.read_text()
    assert source.count(mutant.line) == 1, f"{mutant.name}: not once in {mutant.file}"
    path.write_text(source.replace(mutant.line, mutant.planted))


class Run(msgspec.Struct, frozen=True):
    """What came of one seed.

    Attributes:
        tree: digest of the sources, without the planted fault.
        mutant: its name; empty for the daemon as it is.
        seed, seconds: of the run.
        broken: the promise that was broken, or an empty text.
        cpu_s: what it took, start and end included.
        config: name of the robot's file.
    """

    tree: str
    mutant: str
    seed: int
    seconds: int
    broken: str
    cpu_s: float
    config: str = SMALL.name


def tree_digest() -> str:
    """Return a digest of what a run depends on."""
    digest = blake2b(digest_size=8)
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*")):
            if path.suffix in (".py", ".toml"):
                digest.update(path.read_bytes())
    digest.update(SMALL.read_bytes())
    return digest.hexdigest()


def outcome(folder: Path, seed: int, seconds: int, config: Path = SMALL) -> str:
    """Return what a seed breaks in the daemon of a folder; nothing is an empty text.

    It runs in a child of this process, which has loaded what does not belong to the project.
    """
    answer, said = os.pipe()
    child = os.fork()
    if not child:
        os.close(answer)
        os.write(said, _simulate(folder, seed, seconds, config).encode())
        os._exit(0)
    os.close(said)
    with open(answer, "rb") as pipe:
        broken = pipe.read().decode()
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    return broken or (f"it ended with {status}" if status else "")


def _simulate(folder: Path, seed: int, seconds: int, config: Path) -> str:
    os.chdir(folder)
    sys.path.insert(0, str(folder))
    assert "skin_host" not in sys.modules, "this process has the daemon as it is"
    logging.disable(logging.CRITICAL)
    try:
        from skin_host.cli.common import load_skin
        from skin_host.evaluation.simulate.run import simulate

        settings, layout = load_skin(config)
        return simulate(settings, layout, config, seed, seconds).broken or ""
    except BaseException as error:
        return f"{type(error).__name__}: {error}"


class Search:
    """Runs seeds with planted faults, and keeps what came of them.

    Args:
        mutants: to be planted.
        seconds: simulated time of each run.
        results: file to append runs to, and to take those from that it has.
    """

    def __init__(self, mutants: Iterable[Mutant], seconds: int, results: Path | None) -> None:
        self._mutants = list(mutants)
        self._seconds = seconds
        self._results = results
        self._tree = tree_digest()
        self._runs: dict[tuple[str, str, int], Run] = {}
        if results is not None and results.exists():
            for line in results.read_bytes().splitlines():
                run = msgspec.json.decode(line, type=Run)
                if (run.tree, run.seconds) == (self._tree, seconds):
                    self._runs[run.mutant, run.config, run.seed] = run

    def find(self, seeds: Iterable[int]) -> Iterator[tuple[Mutant, Run, float]]:
        """Yield each mutant that is found, the run that finds it, and the CPU time of all its runs.

        Args:
            seeds: tried in this order, each with all that is left; one that breaks a promise of
                the daemon as it is proves nothing and is passed over.
        """
        spent_s = dict.fromkeys(self._mutants, 0.0)
        with tempfile.TemporaryDirectory() as name:
            left = {mutant: Path(name) / str(i) for i, mutant in enumerate(self._mutants)}
            for mutant, folder in left.items():
                plant(mutant, folder)
            for seed in seeds:
                for mutant, folder in list(left.items()):
                    run = self._run(mutant.name, folder, mutant.config, seed)
                    spent_s[mutant] += run.cpu_s
                    if not run.broken:
                        continue
                    plain = self._run("", ROOT, mutant.config, seed)
                    if plain.broken:
                        print(f"seed {seed} does not count: {plain.broken}", flush=True)
                        continue
                    del left[mutant]
                    yield mutant, run, spent_s[mutant]

    def _run(self, name: str, folder: Path, config: Path, seed: int) -> Run:
        key = name, config.name, seed
        if key not in self._runs:
            before = os.times()
            broken = outcome(folder, seed, self._seconds, config)
            after = os.times()
            cpu_s = after.children_user + after.children_system
            cpu_s -= before.children_user + before.children_system
            run = Run(self._tree, name, seed, self._seconds, broken, round(cpu_s, 2), config.name)
            self._runs[key] = run
            if self._results is not None:
                with self._results.open("ab") as file:
                    file.write(msgspec.json.encode(run) + b"\n")
        return self._runs[key]


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, default=200)
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--seconds", type=int, default=29)
    parser.add_argument("--results", type=Path)
    parser.add_argument("--only", nargs="*", default=[])
    arguments = parser.parse_args()
    chosen = [m for m in MUTANTS if not arguments.only or any(w in m.name for w in arguments.only)]
    seeds = range(arguments.first, arguments.first + arguments.seeds)
    found = 0
    search = Search(chosen, arguments.seconds, arguments.results)
    for mutant, run, cpu_s in search.find(seeds):
        found += 1
        print(f"| {mutant.name} | {run.seed} | {run.broken[:110]} | {cpu_s:.0f} s |", flush=True)
    print(f"{found} of {len(chosen)} found within {len(seeds)} seeds")
    return 0


if __name__ == "__main__":
    sys.exit(main())
