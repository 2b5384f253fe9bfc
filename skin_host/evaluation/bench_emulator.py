"""`skin bench emulator`: simulated seconds per second, by boards, fidelity and touch.

Every row is relative to real time: `times_real` is simulated time over the time that one core was
busy, so other work on the machine does not count. The mechanics is timed separately for one to a
thousand touched taxels, pressed and slid over in turns, with the ratio of the two.
"""

import importlib.util
import itertools
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from emulator.probes.scene import Place, Probe, Scene
from emulator.probes.skin import MOVING_NS, Skin
from emulator.robot import Robot
from skin_host.config.settings import Settings
from skin_host.evaluation.rig import wired
from skin_host.layout import Layout, build_layout

Row = dict[str, Any]

SWEEP_S = 0.05
REPEATS = 3
MOTIONS = "pressing", "sliding"
#: Steps of the mechanics in a period of the moving presses.
PERIOD_STEPS = 200
#: How often each motion's steps are timed.
TURNS = 30
#: Instead of a number of touched pads: one on each triangle of a board, as a grasping hand.
HAND = -1


def run(*, quick: bool = False) -> list[Row]:
    """Measure; each row names its part of the bench, what was simulated, and how fast.

    Args:
        quick: simulate a fifth of the time.
    """
    share = 0.2 if quick else 1.0
    rows = [
        _scale(boards, triangles, fidelity, touched, seconds * share)
        for boards, triangles, fidelity, touched, seconds in (
            (1, 16, "chip", 0, 10.0),
            (1, 16, "signal", 0, 20.0),
            (3, 11, "chip", 10, 5.0),
            (3, 11, "signal", 10, 20.0),
            (30, 11, "chip", 0, 10.0),
            (30, 11, "chip", HAND, 4.0),
            (30, 11, "signal", 0, 20.0),
            (30, 11, "signal", HAND, 10.0),
            (30, 11, "signal", 1, 10.0),
            (30, 11, "signal", 1000, 5.0),
        )
    ]
    rows += _mechanics(share)
    rows += _bodies(share)
    rows.append(_agreement(20.0 * share))
    return rows


def robot_of(boards: int, triangles: int) -> tuple[Settings, Layout]:
    """Return settings and layout of a robot with one part and this many triangles per board."""
    wiring = wired(boards)
    document = {
        "robot": "bench",
        **wiring,
        "parts": {
            name: {"patches": [{"board": name, "triangles": f"0-{triangles - 1}"}]}
            for name in wiring["boards"]
        },
    }
    settings = msgspec.convert(document, Settings)
    return settings, build_layout(settings, Path())


def moving_presses(layout: Layout, n: int) -> list[Probe]:
    """Probes of 4 mm on n pads of a robot of `robot_of`, pressing harder and softer for ever."""
    return [
        _moving_press(part.name, taxel)
        for part, taxel in [
            (part, taxel) for taxel in range(layout.n_taxels) for part in layout.parts
        ][:n]
    ]


def grasp(layout: Layout) -> list[Probe]:
    """Such a probe on each triangle of the first board."""
    hand = layout.parts[0]
    return [_moving_press(hand.name, first) for first in range(0, hand.stop - hand.start, 12)]


def _moving_press(part: str, taxel: int) -> Probe:
    return Probe(
        part=part,
        at=Place(taxel=taxel),
        diameter_mm=4.0,
        pressure_kpa=[(0.0, 20.0), (0.5, 60.0), (1.0, 20.0)],
        repeat_s=1.0,
    )


def _scale(boards: int, triangles: int, fidelity: str, touched: int, seconds: float) -> Row:
    settings, layout = robot_of(boards, triangles)
    hand = touched == HAND
    probes = grasp(layout) if hand else moving_presses(layout, touched)
    robot = Robot(settings, layout, Scene(probe=probes), fidelity=fidelity)
    robot.bring_up()
    robot.step(1.0)
    sweeps, frames = max(1, round(seconds / SWEEP_S)), 0

    def live() -> None:
        nonlocal frames
        for _ in range(sweeps):
            frames += sum(len(batch) for batch in robot.step(SWEEP_S).values())

    spent_s = _seconds(live, 1)
    return {
        "part": "scale",
        "boards": boards,
        "taxels": layout.n_taxels,
        "fidelity": fidelity,
        "touched": len(probes),
        "on_one_board": hand,
        "simulated_s": round(sweeps * SWEEP_S, 2),
        "frames": frames,
        "times_real": round(sweeps * SWEEP_S / spent_s, 1),
    }


def _mechanics(share: float) -> list[Row]:
    """Cost of a step of foam and pads, with and without sliding, by touched taxels."""
    _, layout = robot_of(30, 11)
    counts = 1, 10, 100, 1000
    turns = max(10, round(TURNS * share))
    step_us: dict[tuple[str, int], float] = {}
    for touched in counts:
        presses = {}
        for motion in MOTIONS:
            probes = moving_presses(layout, touched)
            if motion == "sliding":
                for probe in probes:
                    probe.slide_mm = [(0.0, 0.0, 0.0), (0.5, 1.0, 0.0), (1.0, 0.0, 0.0)]
            skin = Skin(layout, Scene(probe=probes))
            # What some steps of a slide have in common is worked out in one of them.
            times_ns = itertools.count(MOVING_NS, MOVING_NS)
            presses[motion] = partial(_step, skin, times_ns)
            # The first period meets foam that nothing has touched.
            presses[motion]()
            presses[motion]()
        # In turns, so that what else the machine does meets them alike. Periods are the same, so
        # that of each step in them the shortest time counts.
        best_us = {motion: np.full(PERIOD_STEPS, np.inf) for motion in MOTIONS}
        for _ in range(turns):
            for motion, press in presses.items():
                np.minimum(best_us[motion], press(), out=best_us[motion])
        step_us |= {(motion, touched): float(best_us[motion].mean()) for motion in MOTIONS}
    rows: list[Row] = [
        {
            "part": "mechanics",
            "motion": motion,
            "taxels": layout.n_taxels,
            "touched": touched,
            "step_us": round(step_us[motion, touched], 1),
            "us_per_touched": round(step_us[motion, touched] / touched, 2),
        }
        for motion in MOTIONS
        for touched in counts
    ]
    rows += [
        {
            "part": "mechanics ratio",
            "motion": motion,
            "one_against_thousand": round(step_us[motion, 1] / step_us[motion, 1000], 4),
        }
        for motion in MOTIONS
    ]
    rows += [
        {
            "part": "sliding ratio",
            "touched": touched,
            "sliding_against_pressing": round(
                step_us["sliding", touched] / step_us["pressing", touched], 3
            ),
        }
        for touched in counts
    ]
    return rows


def _step(skin: Skin, times_ns: Iterator[int]) -> NDArray[np.float64]:
    """Let a period pass; what each of its steps took, us."""
    took_us = np.empty(PERIOD_STEPS)
    for number, t_ns in enumerate(itertools.islice(times_ns, PERIOD_STEPS)):
        began_ns = time.perf_counter_ns()
        skin.step(t_ns)
        took_us[number] = (time.perf_counter_ns() - began_ns) * 1e-3
    return took_us


def _bodies(share: float) -> list[Row]:
    """A forearm of 288 taxels on which balls lie in a MuJoCo simulation, if that is installed."""
    if importlib.util.find_spec("mujoco") is None:
        return []
    from emulator.probes.mujoco_model import MujocoModel

    document = {
        "robot": "bench",
        **wired(2),
        "parts": {
            "forearm": {
                "patches": [{"board": name, "triangles": "0-11"} for name in wired(2)["boards"]]
            }
        },
    }
    settings = msgspec.convert(document, Settings)
    layout = build_layout(settings, Path())
    rows: list[Row] = []
    for balls in (0, 1, 20):
        with tempfile.TemporaryDirectory(prefix="skin-bench-") as folder:
            path = Path(folder, "model.xml")
            path.write_text(_lying(layout, balls))
            model = MujocoModel(path, layout)
        robot = Robot(settings, layout, source=model)
        robot.bring_up()
        robot.step(0.5)
        seconds = 5.0 * share
        spent_s = _seconds(partial(robot.step, seconds), REPEATS)
        row = {
            "part": "bodies",
            "taxels": layout.n_taxels,
            "balls": balls,
            "contacts": len(robot.skin.contacts),
            "times_real": round(seconds / spent_s, 1),
        }
        rows.append(row)
    return rows


def _lying(layout: Layout, balls: int) -> str:
    """A MuJoCo model of the first part of a robot, flat, with balls of 6 mm on it."""
    part = layout.parts[0]
    places_m = layout.position_m[part.start : part.stop, :2]
    low_m, high_m = places_m.min(axis=0), places_m.max(axis=0)
    middle_m, half_m = (low_m + high_m) / 2, (high_m - low_m) / 2 + 0.01
    at_m = np.random.default_rng(1).uniform(low_m, high_m, (balls, 2))
    lying = "".join(
        f'<body pos="{x_m} {y_m} 0.0031"><joint type="slide" axis="0 0 1"/>'
        '<geom size="0.003" mass="0.05" contype="2" conaffinity="1"/></body>'
        for x_m, y_m in at_m
    )
    return (
        '<mujoco><option timestep="0.002"/><worldbody><body>'
        f'<geom type="box" size="{half_m[0]} {half_m[1]} 0.01" '
        f'pos="{middle_m[0]} {middle_m[1]} -0.01"/><site name="{part.name}"/></body>'
        f"{lying}</worldbody></mujoco>"
    )


def _agreement(seconds: float) -> Row:
    """The same scene and seed at both fidelities: how far the transmitted bytes differ."""
    settings, layout = robot_of(3, 11)
    sent = []
    for fidelity in ("signal", "chip"):
        robot = Robot(settings, layout, Scene(probe=moving_presses(layout, 50)), fidelity=fidelity)
        robot.converters.by_bus = True
        robot.bring_up()
        sent.append(robot.step(seconds)["can0"])
    signal, chip = sent
    difference = np.abs(signal.data.astype(int) - chip.data)
    return {
        "part": "agreement",
        "frames": len(signal),
        "bytes_compared": difference.size,
        "largest_difference": int(difference.max()),
        "same_identifiers_and_times": bool(
            (signal.id == chip.id).all() and (signal.t_ns == chip.t_ns).all()
        ),
    }


def _seconds(work: Callable[[], object], repeats: int) -> float:
    """The shortest processor time that `work` takes."""
    best = np.inf
    for _ in range(repeats):
        start = time.process_time()
        work()
        best = min(best, time.process_time() - start)
    return float(best)


def describe(rows: list[Row]) -> str:
    """The rows as text."""
    lines = ["Simulated seconds per second (real time is 1):"]
    lines += [
        f"  {row['boards']:3d} boards {row['taxels']:5d} taxels  {row['fidelity']:6s} "
        f"{row['touched']:5d} touched  {row['times_real']:7.1f}"
        + ("  (one board: a hand)" if row["on_one_board"] else "")
        for row in rows
        if row["part"] == "scale"
    ]
    lines.append("One step of the mechanics (5 ms simulated while something moves):")
    lines += [
        f"  {row['motion']:8s} {row['touched']:5d} of {row['taxels']} touched "
        f"{row['step_us']:9.1f} us"
        for row in rows
        if row["part"] == "mechanics"
    ]
    lines += [
        f"  {row['motion']:8s} one touched taxel costs 1/{1 / row['one_against_thousand']:.1f} "
        "of a thousand"
        for row in rows
        if row["part"] == "mechanics ratio"
    ]
    lines += [
        f"  sliding {row['touched']:5d} costs {row['sliding_against_pressing']:.2f} of pressing"
        for row in rows
        if row["part"] == "sliding ratio"
    ]
    lines += [
        f"MuJoCo: {row['balls']:2d} balls on a part of {row['taxels']} taxels, "
        f"{row['contacts']} contacts  {row['times_real']:7.1f}"
        for row in rows
        if row["part"] == "bodies"
    ]
    lines += [
        f"Signal against chip: {row['bytes_compared']} bytes, "
        f"largest difference {row['largest_difference']}"
        for row in rows
        if row["part"] == "agreement"
    ]
    return "\n".join(lines)
