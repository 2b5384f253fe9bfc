"""Every fault on every firmware and fidelity, at rest and in a touch: what is reported, how soon.

    python -m tests.support.fault_matrix [docs/faults.md]

In stepped time, on two boards of eight triangles with quiet pads. Writes the page whole.
"""

import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from emulator.probes.scene import Place, Probe, Scene
from skin_host.files import write_atomic
from tests.support.fault_bench import FaultBench

MODELS = ("mtb3", "mtb4", "mtb4c")
FIDELITIES = ("chip", "signal")
PAGE = Path(__file__).parents[2] / "docs" / "faults.md"
HERE: dict[str, Any] = {"board": "one", "triangle": 3}


@dataclass(frozen=True)
class Bound:
    """By when a fault must be reported, and what the time is made of.

    Attributes:
        why: follows from constants of the host, which stand in brackets.
        rest_s, touch_s: at rest and while its triangle is pressed.
    """

    why: str
    rest_s: float
    touch_s: float


#: Boards send every 50 ms, chips convert in 37 ms, health looks every 100 ms.
SWEEP = Bound(
    "the next sweep shows it: a period, a conversion, the end of the sweep, a look", 0.3, 0.3
)
SILENT = Bound(
    "four periods without a frame (`silent_periods`), of an MTB3 six (`MTB3_PERIODS`), "
    "and two looks",
    0.5,
    0.5,
)
INTERVALS = Bound("16 intervals between sweeps (`INTERVALS`), and two looks", 1.0, 1.0)
LOAD = Bound("the load of the last second (`RECENT_NS`), and a look", 1.1, 1.1)
CHANCE = Bound(
    "two of some 5 events a second within one second; chance is later once in 1000", 2.5, 2.5
)
CALM = Bound(
    "two pads of some 5 events a second within ten seconds, where nothing is touched, and some 25 "
    "conversions in which they do not jump again (`LATELY_MEAN`)",
    3.8,
    3.8,
)
JUMPS = Bound(
    "jumps in 8 conversions on the average (`NOISE_MEMORY_CONVERSIONS`), by chance up to 2 s",
    2.0,
    2.0,
)
RUN = Bound(
    "repeats with odds of one in 10^11 (`ODDS`), twice as many in the first minutes; six times as "
    "many (`TOUCHED_PACE`) while anything else on the board is touched, as hands hold that still",
    8.0,
    48.0,
)
FEW_BITS = Bound(
    "one reading in five of each of four chips is damaged; until a value is far out", 1.0, 1.0
)
#: Fault, what it is given, the code that is expected, by when.
FAULTS: list[tuple[str, dict[str, Any], str, Bound]] = [
    ("late_period", {"board": "one"}, "board_period", INTERVALS),
    ("jittered_period", {"board": "one"}, "board_jitter", INTERVALS),
    ("frame_loss", {"bus": "can0"}, "bus_loses_frames", CHANCE),
    ("bit_errors", {"bus": "can0", "value": 0.01}, "bus_bit_errors", CALM),
    ("babbling_node", {"bus": "can0"}, "bus_babbling", LOAD),
    ("board_silent", {"board": "one"}, "board_silent", SILENT),
    ("bus_off", {"bus": "can0"}, "bus_silent", SILENT),
    ("noisy_taxel", HERE | {"taxel": 4}, "taxel_noisy", JUMPS),
    ("stuck_taxel", HERE | {"taxel": 7}, "taxel_stuck", RUN),
    ("chip_gone", HERE, "triangle_not_connected", SWEEP),
    ("chip_back", HERE, "triangle_not_connected", SWEEP),
    ("wrong_address", HERE | {"value": 0}, "triangle_not_connected", SWEEP),
    ("swapped_lines", HERE, "lines_swapped", SWEEP),
    ("shorted_finger", HERE, "line_shorted", SWEEP),
    ("shared_address", HERE | {"value": 0}, "triangle_not_connected", SWEEP),
    ("no_acknowledge", HERE, "triangle_no_ack", SWEEP),
    ("data_held_low", HERE, "triangle_no_ack", SWEEP),
    ("clock_stretched", HERE, "triangle_out_of_range", SWEEP),
    ("bit_flipped", HERE, "taxel_out_of_range", FEW_BITS),
    ("slow_rise", HERE, "taxel_out_of_range", SWEEP),
    ("brown_out", HERE, "triangle_no_ack", SWEEP),
    ("temperature_step", {}, "part_temperature", SWEEP),
    ("board_reset", {"board": "one"}, "board_silent", SILENT),
]
#: After these the firmware may have taken a new zero, or its chips have no set-up.
SPOIL = {
    "shorted_finger",
    "chip_gone",
    "chip_back",
    "shared_address",
    "no_acknowledge",
    "data_held_low",
    "clock_stretched",
    "bit_flipped",
    "slow_rise",
    "brown_out",
    "board_reset",
}
LOOK_S = 0.1
MEND_S = 1.5
TOUCH_KPA = 60.0

INTRODUCTION = """\
What health reports of each fault that the emulator knows, and how soon: on every firmware and at
both fidelities of the chips, at rest and while the triangle of the fault is pressed. Measured in
stepped time by `python -m tests.support.fault_matrix`, which writes this page, on two boards of
eight triangles with quiet pads. Times are of the first report of the expected code, in brackets
what else was reported by then; `chip_back`: until the code is gone. `within` is the time by which
the code is expected on every firmware and fidelity; a cell that is later, or in which the code
did not come, is bold. Health is worked out every 0.1 s here. The daemon looks for changes as often,
and works out periods, temperatures and baselines once a second. [scenes.md](scenes.md) explains
the faults. `board_latched` is of force/torque boards: `fingertip_frozen` after 250 samples
([operations.md](operations.md))."""

REASONS = """\
## What is expected

| within, at rest (in a touch) | because | of |
|---|---|---|
"""

CONFIGURATION = """
robot = "matrix"

[buses.can0]
interface = "virtual"

[boards.one]
bus = "can0"
address = 1
model = "{model}"

[boards.two]
bus = "can0"
address = 2
model = "{model}"

[[parts.skin.patches]]
board = "one"
triangles = "0-7"
kind = "triangle_10pad"

[[parts.skin.patches]]
board = "two"
triangles = "0-7"
kind = "triangle_10pad"
"""


@dataclass(frozen=True)
class Cell:
    """What came of a fault: seconds until its code, and what else was reported by then."""

    seconds: float | None
    others: tuple[str, ...]

    def text(self, within_s: float) -> str:
        """The cell; bold if the fault was not reported by then."""
        if self.seconds is None:
            found = f"**not in {within_s:g} s**"
        elif self.seconds > within_s:
            found = f"**{self.seconds:.1f} s**"
        else:
            found = f"{self.seconds:.1f} s"
        return found + (f" ({', '.join(self.others)})" if self.others else "")


def bench_of(model: str, fidelity: str, *, touched: bool) -> FaultBench:
    """A calibrated robot; in a touch, triangle 3 of board one is pressed from now on."""
    probes = []
    if touched:
        probes = [
            Probe(
                part="skin",
                at=Place(triangle=3),
                diameter_mm=14.0,
                pressure_kpa=[(0, 0), (0.2, TOUCH_KPA), (1e6, TOUCH_KPA)],
                start_s=7.0,
            )
        ]
    with tempfile.TemporaryDirectory() as folder:
        config = Path(folder, "matrix.toml")
        config.write_text(CONFIGURATION.format(model=model))
        bench = FaultBench(
            4.0,
            Scene(quiet=True, probe=probes),
            config=config,
            fidelity=fidelity,
            settle_s=5.0,
        )
    assert bool(bench.touched["skin"].any()) == touched
    return bench


def column(model: str, fidelity: str, touched: bool) -> list[Cell]:
    """All faults of one firmware and fidelity, one after the other."""
    cells = []
    bench: FaultBench | None = None
    for name, arguments, code, bound in FAULTS:
        within_s = bound.touch_s if touched else bound.rest_s
        if bench is None or bench.told:
            bench = bench_of(model, fidelity, touched=touched)
        before = {told for told, _ in bench.told}
        mend = None
        if name == "chip_back":
            bench.inject("chip_gone", **arguments)
            bench.run(1.0)
            bench.inject(name, **arguments)
            cell = _cleared(bench, code, within_s)
        else:
            mend = bench.inject(name, **arguments)
            cell = _reported(bench, code, before, within_s)
        cells.append(cell)
        if mend is not None:
            mend()
        bench.run(MEND_S)
        if name in SPOIL:
            bench = None
    return cells


def _reported(bench: FaultBench, code: str, before: set[str], within_s: float) -> Cell:
    start_s = bench.t_s
    while bench.t_s < start_s + within_s + LOOK_S:
        bench.run(LOOK_S)
        at_s = [t_s for (told, _), t_s in bench.first_told.items() if told == code]
        if at_s:
            others = {told for told, _ in bench.first_told} - {code} - before
            return Cell(min(at_s) - start_s, tuple(sorted(others)))
    return Cell(None, tuple(sorted({told for told, _ in bench.first_told} - before)))


def _cleared(bench: FaultBench, code: str, within_s: float) -> Cell:
    start_s = bench.t_s
    while bench.t_s < start_s + within_s + LOOK_S:
        bench.run(LOOK_S)
        if code not in {told for told, _ in bench.told}:
            return Cell(bench.t_s - start_s, ())
    return Cell(None, (code,))


def page(columns: dict[tuple[str, str, bool], list[Cell]]) -> str:
    """The table as Markdown."""
    kinds = [(model, fidelity) for model in MODELS for fidelity in FIDELITIES]
    lines = [
        "# Faults",
        "",
        INTRODUCTION,
        "",
    ]
    for touched in (False, True):
        lines += [f"## {'In a touch' if touched else 'At rest'}", ""]
        head = ["fault", "code", "within", *(f"{model} {fidelity}" for model, fidelity in kinds)]
        lines += ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
        for row, (name, _, code, bound) in enumerate(FAULTS):
            within_s = bound.touch_s if touched else bound.rest_s
            cells = [
                columns[kind, fidelity, touched][row].text(within_s) for kind, fidelity in kinds
            ]
            start = [f"`{name}`", f"`{code}`", f"{within_s:g} s"]
            lines.append("| " + " | ".join([*start, *cells]) + " |")
        lines.append("")
    return "\n".join(lines) + "\n" + _reasons()


def _reasons() -> str:
    rows = []
    for bound in dict.fromkeys(bound for *_, bound in FAULTS):
        of = ", ".join(f"`{name}`" for name, _, _, own in FAULTS if own == bound)
        touch = "" if bound.touch_s == bound.rest_s else f" ({bound.touch_s:g} s)"
        rows.append(f"| {bound.rest_s:g} s{touch} | {bound.why} | {of} |\n")
    return REASONS + "".join(rows)


def measured() -> Iterator[tuple[tuple[str, str, bool], list[Cell]]]:
    """All columns, side by side."""
    keys = [(m, f, touched) for m in MODELS for f in FIDELITIES for touched in (False, True)]
    with get_context("spawn").Pool(2) as pool:
        yield from zip(keys, pool.starmap(column, keys, chunksize=1), strict=True)


def main(path: Path) -> None:
    write_atomic(path, page(dict(measured())).encode())


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else PAGE)
