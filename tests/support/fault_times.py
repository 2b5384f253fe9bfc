"""How soon each fault of the catalogue is told and disbelieved, in many places of the robot.

python -m tests.support.fault_times [--trials 24] [--names stuck_taxel,...]
"""

import argparse
from typing import Any

import numpy as np

from emulator.faults import KINDS
from skin_host.processing.calibration import Verdict
from tests.support.branch import branch
from tests.support.fault_bench import FaultBench

#: What must be told of each; a word that a dead chip reads as makes three kinds of one.
CODES: list[tuple[str, float | None, str]] = [
    ("chip_gone", None, "triangle_not_connected"),
    ("chip_gone", 0, "triangle_no_ack"),
    ("chip_gone", 0x8000, "triangle_out_of_range"),
    ("stuck_taxel", None, "taxel_stuck"),
    ("stuck_taxel", 40, "taxel_stuck"),
    ("noisy_taxel", None, "taxel_noisy"),
    ("shorted_finger", None, "line_shorted"),
    ("wrong_address", None, "triangle_not_connected"),
    ("swapped_lines", None, "lines_swapped"),
    ("board_reset", None, "board_silent"),
    ("board_silent", None, "board_silent"),
    ("late_period", None, "board_period"),
    ("jittered_period", None, "board_jitter"),
    ("frame_loss", None, "bus_loses_frames"),
    ("bit_errors", 0.01, "bus_bit_errors"),
    ("bus_off", None, "bus_silent"),
    ("babbling_node", None, "bus_babbling"),
    ("temperature_step", None, "part_temperature"),
]
#: Faults of what is behind a triangle: nothing it sends may be believed.
DOUBTED = {"chip_gone", "stuck_taxel", "noisy_taxel", "shorted_finger", "wrong_address"}
LONGEST_S = 60.0
HEAD = """| fault | reported as | after, median (longest) s | not valid after, longest s |
|---|---|---|---|"""
STEP_S = 0.1


def arguments(name: str, bench: FaultBench, rng: np.random.Generator) -> dict[str, Any]:
    """Where it happens: somewhere that has what the fault needs."""
    needs = KINDS[name].needs
    layout = bench.layout
    if name in {"shorted_finger", "wrong_address", "swapped_lines"}:
        # Full data lines: those of the forearm.
        return {"board": "forearm_outer", "triangle": int(rng.integers(3))}
    if name == "jittered_period":
        # Bursts of the others wait behind those of higher priority anyway, and even out.
        return {"board": "forearm_inner"}
    triangle = layout.triangles[rng.integers(len(layout.triangles))]
    found: dict[str, Any] = {}
    if "board" in needs:
        found["board"] = layout.boards[triangle.board].name
    if "triangle" in needs:
        found["triangle"] = triangle.number
    if "taxel" in needs:
        pads = slice(triangle.first, triangle.first + 12)
        calibration = bench.engine.calibration
        assert calibration is not None
        # Some are noisy from birth.
        sound = (layout.pad_kind[pads] == 0) & (calibration.verdict[pads] == Verdict.OK)
        found["taxel"] = int(rng.choice(np.flatnonzero(sound)))
    if "bus" in needs:
        found["bus"] = "can0"
    return found


def places(name: str, where: dict[str, Any], bench: FaultBench) -> np.ndarray:
    """Flat taxels that may not be believed."""
    if name not in DOUBTED:
        return np.zeros(0, np.int32)
    board = next(board for board in bench.layout.boards if board.name == where["board"])
    taxels = board.taxel_index[where["triangle"]]
    return taxels[where["taxel"]][None] if "taxel" in where else taxels


def trial(
    calibrated: FaultBench, name: str, value: float | None, code: str, rng: np.random.Generator
) -> tuple[float, float]:
    """Seconds until the fault is told, and until nothing is believed that must not be."""
    bench = branch(calibrated)
    bench.run(float(rng.integers(20)) * 0.05)
    where = arguments(name, bench, rng)
    taxels = places(name, where, bench)
    # A pad that the calibration refused is told of already.
    before = {key for key in bench.told if key[0] == code}
    bench.inject(name, **where, **({} if value is None else {"value": value}))
    doubted_s = 0.0 if not len(taxels) else np.inf
    for _ in range(round(LONGEST_S / STEP_S)):
        bench.run(STEP_S)
        seconds = bench.t_s - bench.since_s
        valid = np.concatenate([bench.valid[part.name] for part in bench.layout.parts])
        if doubted_s == np.inf and not valid[taxels].any():
            doubted_s = seconds
        told = {key for key in bench.first_told if key[0] == code} - before
        if told and doubted_s < np.inf:
            return min(bench.first_told[key] for key in told) - bench.since_s, doubted_s
    return np.inf, doubted_s


def main() -> None:
    """Print a row per fault."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--trials", type=int, default=24)
    parser.add_argument("--names", default=",".join(KINDS))
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args()
    rng = np.random.default_rng(asked.seed)
    bench = FaultBench()
    bench.run(60.0)
    print(HEAD)  # noqa: T201
    for name, value, code in CODES:
        if name not in asked.names.split(","):
            continue
        times = np.array([trial(bench, name, value, code, rng) for _ in range(asked.trials)])
        word = "" if value is None else f" {value:#x}" if name == "chip_gone" else f" {value}"
        told, doubted = times.T
        disbelieved = f"{doubted.max():.1f}" if name in DOUBTED else ""
        share = f"{np.median(told):.1f} ({told.max():.1f})"
        print(f"| `{name}`{word} | `{code}` | {share} | {disbelieved} |", flush=True)  # noqa: T201


if __name__ == "__main__":
    main()
