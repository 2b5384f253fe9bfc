"""What health keeps in mind of parts, boards and buses between two records."""

from dataclasses import dataclass, field
from typing import Any

import msgspec
import numpy as np
import pytest

from skin_host.bus.port import PortCounters
from skin_host.config.settings import load
from skin_host.health.watch import BoardWatch, BusWatch, PartWatch, Watch, Window
from skin_host.layout import build_layout
from skin_host.processing.core import Engine, Step
from skin_host.processing.frame import PressureFrame
from tests.support.fault_bench import CONFIG

MS = 1_000_000
S = 1000 * MS
PERIOD = 50 * MS
#: Of two triangles.
N = 24
FIRST, SECOND = list(range(12)), list(range(12, 24))


def note(
    watch: PartWatch,
    t_ns: int,
    lost: tuple[int, ...] = (),
    valid: bool = True,
    set_ns: int = 0,
) -> PressureFrame:
    """A sample in which triangles were not received, by a clock that was set by `set_ns`."""
    raw = np.full(N, 240, np.uint8)
    here = np.full(N, valid)
    for triangle in lost:
        raw[12 * triangle : 12 * (triangle + 1)] = 0
        here[12 * triangle : 12 * (triangle + 1)] = False
    none = np.zeros(N, np.bool_)
    kpa = np.zeros(N, np.float32)
    frame = PressureFrame("arm", 0, t_ns, raw, kpa, none, here, none, elapsed_ns=t_ns - set_ns)
    watch.note(Step(0, frame, []), None)
    return frame


def late(watch: PartWatch) -> list[int]:
    return [] if watch.late is None else np.flatnonzero(watch.late).tolist()


def test_a_rate_is_the_mean_over_two_seconds_of_samples_with_a_valid_taxel() -> None:
    watch = PartWatch(late_samples=3)
    for turn in range(1, 42):
        assert watch.rate_hz == 0.0
        note(watch, turn * PERIOD)
    assert watch.rate_hz == pytest.approx(20.0)
    for turn in range(42, 82):
        note(watch, turn * PERIOD, valid=turn % 2 == 0)
    assert watch.rate_hz == pytest.approx(10.0)
    assert watch.frames == 61
    assert watch.last_ns == 80 * PERIOD


@pytest.mark.parametrize("set_ns", [3600_000 * MS, -3600_000 * MS])
def test_a_clock_that_is_set_changes_no_rate(set_ns: int) -> None:
    watch = PartWatch(late_samples=3)
    for turn in range(1, 42):
        note(watch, turn * PERIOD)
    for turn in range(42, 142):
        note(watch, turn * PERIOD + set_ns, set_ns=set_ns)
        assert watch.rate_hz == pytest.approx(20.0)


def test_a_triangle_whose_frames_are_lost_is_late_for_a_few_samples_and_then_not() -> None:
    watch = PartWatch(late_samples=3)
    note(watch, PERIOD)
    assert late(watch) == []
    note(watch, 2 * PERIOD, lost=(1,))
    assert late(watch) == SECOND
    note(watch, 3 * PERIOD, lost=(1,))
    assert late(watch) == SECOND
    note(watch, 4 * PERIOD, lost=(1,))
    assert late(watch) == []
    note(watch, 5 * PERIOD)
    note(watch, 6 * PERIOD, lost=(0,))
    assert late(watch) == FIRST
    # The other one goes, and this one comes: each is counted by itself.
    note(watch, 7 * PERIOD, lost=(1,))
    assert late(watch) == SECOND
    note(watch, 8 * PERIOD, lost=(0, 1))
    # A sample of nothing reports silence, not lateness.
    assert late(watch) == []


@pytest.mark.parametrize(("silent_periods", "samples"), [(4.0, 4), (5.0, 5), (6.5, 6)])
def test_a_triangle_is_late_until_a_board_that_sends_nothing_has_timed_out(
    silent_periods: float, samples: int
) -> None:
    settings = load(CONFIG)
    receive = msgspec.structs.replace(settings.receive, silent_periods=silent_periods)
    settings = msgspec.structs.replace(settings, receive=receive)
    watch = Watch(Engine(settings, build_layout(settings, CONFIG.parent), [0])).parts[0]
    note(watch, PERIOD)
    found = []
    for turn in range(2, 12):
        note(watch, turn * PERIOD, lost=(1,))
        found.append(late(watch) == SECOND)
    assert found == [True] * samples + [False] * (10 - samples)


def test_what_was_not_valid_before_is_not_late() -> None:
    watch = PartWatch(late_samples=3)
    note(watch, PERIOD, lost=(1,))
    assert late(watch) == []
    note(watch, 2 * PERIOD, valid=False)
    note(watch, 3 * PERIOD, lost=(0,))
    assert late(watch) == []


def test_events_of_a_board_are_dated_when_their_count_rises() -> None:
    watch = BoardWatch()
    watch.note({"resets": 0, "rezeros": 2}, 10)
    assert watch.event_ns == {"rezeros": 10}
    watch.note({"resets": 1, "rezeros": 2}, 20)
    assert watch.event_ns == {"rezeros": 10, "resets": 20}
    watch.note({"resets": 1, "rezeros": 2}, 30)
    assert watch.event_ns == {"rezeros": 10, "resets": 20}
    assert watch.events == {"resets": 1, "rezeros": 2}


def test_a_window_gives_what_was_gained_in_about_its_length() -> None:
    window = Window(S)
    gains = [window.note(turn * 250 * MS, {"frames": turn * turn}) for turn in range(10)]
    assert gains[0] == {"frames": 0, "seconds": 0.0}
    assert gains[3] == {"frames": 9, "seconds": pytest.approx(0.75)}
    assert gains[4] == {"frames": 16, "seconds": pytest.approx(1.0)}
    assert gains[9] == {"frames": 81 - 25, "seconds": pytest.approx(1.0)}
    # After a pause, or with rare looks, it is as long as it must be.
    assert window.note(60 * S, {"frames": 100}) == {
        "frames": 19,
        "seconds": pytest.approx(60 - 2.25),
    }
    # A clock that was set back begins a new one.
    assert window.note(5 * S, {"frames": 500}) == {"frames": 0, "seconds": 0.0}


def test_a_bus_is_silent_when_no_frame_came_for_too_long_unless_none_is_expected() -> None:
    watch = BusWatch()
    silent = []
    for turn, frames in enumerate((3, 9, 9, 9, 9, 9, 12), start=1):
        now_ns = turn * 100 * MS
        watch.note(now_ns, now_ns, {"frames": frames}, silent_after_ns=300 * MS)
        silent.append(watch.silent)
    assert silent == [False] * 5 + [True, False]
    assert watch.gained == {"frames": 12 - 3, "seconds": pytest.approx(0.6)}
    watch.note(2 * S, 2 * S, {"frames": 12}, silent_after_ns=300 * MS, awaited=True)
    assert not watch.silent
    # A set clock makes nothing silent: only what the ledger has seen pass counts.
    watch.note(9 * S, 800 * MS, {"frames": 12}, silent_after_ns=300 * MS)
    assert not watch.silent


@dataclass
class Counted:
    """Of a port, what is counted there."""

    counters: PortCounters = field(default_factory=PortCounters)


def test_what_a_bus_gained_adds_up_all_that_was_unknown_or_damaged() -> None:
    settings = load(CONFIG)
    layout = build_layout(settings, CONFIG.parent)
    engine = Engine(settings, layout, list(range(len(layout.parts))))
    watch, port = Watch(engine), Counted()
    bus = next(iter(engine.assemblers))
    ports: Any = {bus: port}
    watch.tick(0, ports, {})
    counters = engine.assemblers[bus].counters
    counters.frames, counters.sweeps, counters.other = 100, 9, 11
    counters.unknown_board, counters.unknown_triangle = 2, 3
    counters.wrong_header, counters.short, port.counters.damaged = 1, 4, 20
    counters.halves, counters.missed = 6, 7
    port.counters.dropped, port.counters.error_frames = 8, 13
    port.counters.controller_overflows = 5
    engine.intake.liveness.spikes[:, 3] = 1
    watch.tick(100 * MS, ports, {})
    boards = [one for one in engine.boards if layout.boards[one].settings.bus == bus]
    assert watch.buses[bus].gained == {
        "frames": 100,
        "sweeps": 9,
        "other": 11,
        "elsewhere": 0,
        "wrong": 1 + 4 + 20,
        "halves": 6,
        "missed": 7,
        "unknown": 2 + 3,
        "unconfigured": 2,
        "spikes": 16 * len(boards),
        "dropped": 8,
        "overflows": 5,
        "error_frames": 13,
        "seconds": pytest.approx(0.1),
    }


@pytest.mark.parametrize("counter", ["dropped", "controller_overflows"])
@pytest.mark.parametrize("set_s", [0, 3600, -3600])
def test_frames_that_were_lost_here_are_known_until_all_that_lack_them_are_forgotten(
    counter: str, set_s: int
) -> None:
    """Their other halves are counted with the sweep after them, and for a second from then on."""
    settings = load(CONFIG)
    engine = Engine(settings, build_layout(settings, CONFIG.parent), [0])
    watch, port = Watch(engine), Counted()
    bus = next(iter(engine.assemblers))
    ports: Any = {bus: port}
    known = []
    for turn in range(40):
        now_ns = turn * 100 * MS + (set_s * S if turn >= 3 else 0)
        if turn == 2:
            setattr(port.counters, counter, 1)
        watch.tick(now_ns, ports, {})
        known.append(watch.buses[bus].lost_here(now_ns))
    assert known[:2] == [False] * 2
    if not set_s:
        assert known[2:21] == [True] * 19
    assert known[23:] == [False] * 17


def test_pads_that_were_off_for_one_sweep_count_once_each_for_ten_seconds() -> None:
    settings = load(CONFIG)
    layout = build_layout(settings, CONFIG.parent)
    engine = Engine(settings, layout, list(range(len(layout.parts))))
    watch, bus = Watch(engine), next(iter(engine.assemblers))
    board = next(one for one in engine.boards if layout.boards[one].settings.bus == bus)
    triangle = 16 * engine.ledger.row[board] + 2
    found = []
    for second in range(30):
        # A pad that jumps every three seconds, and another one, once.
        engine.intake.liveness.spikes[triangle, 4] += second % 3 == 0 and second < 16
        engine.intake.liveness.spikes[triangle, 9] += second == 7
        watch.tick(second * S, {}, {})
        found.append(watch.buses[bus].spiked_pads)
    assert found == [1] * 7 + [2] * 10 + [1] * 8 + [0] * 5
