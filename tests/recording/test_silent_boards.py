"""Skin that is not received any more in a recording: it ends as lost, as with the daemon."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from skin_host.bus.logs import read_channels
from skin_host.bus.wire import FrameBatch, encode_sweep
from skin_host.daemon.link import Link
from skin_host.errors import LogError
from skin_host.health import HealthWatch
from skin_host.layout import load_skin
from skin_host.mqtt.contact import PartContact
from skin_host.processing.core import EXPIRE_NS, Engine, Output
from skin_host.recording.export import read_frames
from skin_host.recording.replay import (
    calibrate_from_log,
    contacts_of,
    read_buses,
    replay,
    timed,
)
from tests.support.ports import StillPort

T0_S = 1_700_000_000
T0_NS = T0_S * 10**9
PERIOD_S = 0.05
LAST_S = 12.0
PRESSED_S = 5.5, 11.0
#: A board stops while it is pressed, and comes back.
STOPS_S, BACK_S = 6.5, 9.0

#: Whether a board, by its number, sends at this time; and by how many units its zero has moved.
Sends = Callable[[int, float], bool]
Moved = Callable[[float], float]


def skin(buses: int, *, joined: bool = False) -> str:
    """Two boards, each with a part of its own or together with one, on one bus or two."""
    parts = [("arm", ["a", "b"])] if joined else [("arm", ["a"]), ("leg", ["b"])]
    lines = ['robot = "bench"']
    lines += [f'[buses.{name}]\nchannel = "{name}"' for name in ("can0", "can1")[:buses]]
    for number, name in enumerate("ab"):
        lines.append(f'[boards.{name}]\nbus = "can{number % buses}"\naddress = {3 + number}')
    for part, boards in parts:
        patches = ", ".join(f'{{ board = "{one}", triangles = "0-1" }}' for one in boards)
        lines.append(f"[parts.{part}]\npatches = [{patches}]")
    return "\n".join(lines) + "\n"


def write(
    folder: Path,
    buses: int,
    sends: Sends,
    moved: Moved = lambda _: 0.0,
    *,
    joined: bool = False,
    last_s: float = LAST_S,
) -> tuple[Path, Path]:
    """Write a configuration, and a recording in which the first board is pressed."""
    config, log = folder / "skin.toml", folder / "a.log"
    config.write_text(skin(buses, joined=joined))
    rng = np.random.default_rng(0)
    rest = rng.uniform(235.0, 241.0, (2, 2, 12))
    frames: list[tuple[int, str]] = []
    for period in range(round(last_s / PERIOD_S)):
        t_s = period * PERIOD_S
        units = rest + rng.normal(0.0, 0.4, rest.shape)
        pressed = np.zeros(rest.shape)
        pressed[0, 0, 3:6] = 60.0
        units -= pressed * ((PRESSED_S[0] <= t_s < PRESSED_S[1]) - moved(t_s))
        raw = np.clip(np.rint(units), 0, 255).astype(np.uint8)
        for number in range(2):
            if not sends(number, t_s):
                continue
            ids, data = encode_sweep(3 + number, np.arange(2), raw[number], np.zeros(2, np.uint16))
            for i, (can_id, payload) in enumerate(zip(ids, data, strict=True)):
                us = round(t_s * 1e6) + 100 * i + 13_000 * number + 2_000
                text = payload.tobytes().hex().upper()
                stamp = f"({T0_S + us // 10**6}.{us % 10**6:06d})"
                frames.append((us, f"{stamp} can{number % buses} {can_id:03X}#{text}\n"))
    log.write_text("".join(line for _, line in sorted(frames)))
    return config, log


def stops(number: int, t_s: float) -> bool:
    """The first board stops for ever."""
    return number == 1 or t_s < STOPS_S


def comes_back(number: int, t_s: float) -> bool:
    """The first board pauses."""
    return number == 1 or not STOPS_S <= t_s < BACK_S


def all_pause(_: int, t_s: float) -> bool:
    """No board is received for a while."""
    return not STOPS_S <= t_s < BACK_S


def none_stops(number: int, t_s: float) -> bool:
    return True


def zeroed(t_s: float) -> float:
    """The boards come back zeroed with what presses them."""
    return float(t_s >= BACK_S)


@dataclass
class Told:
    """What a part of the host reports: events but moves, and changes of contact, with their times.

    Attributes:
        health: state and faults of each part at the end.
    """

    engine: Engine
    events: list[tuple[float, str, str, str | None]] = field(default_factory=list)
    contacts: list[tuple[float, str, str]] = field(default_factory=list)
    health: list[tuple[str, object]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._watch = HealthWatch(self.engine)
        self._contacts: dict[int, PartContact] = contacts_of(self.engine)
        self._states: dict[int, str] = {}

    def take(self, output: Output) -> None:
        self._watch.note(output)
        for step in output.steps:
            t_s = (step.frame.t_ns - T0_NS) * 1e-9
            state = self._contacts[step.part].step(step.frame, step.events)
            if self._states.get(step.part) != state:
                self._states[step.part] = state
                self.contacts.append((round(t_s, 6), step.frame.part, state))
            for event in step.events:
                if event.event != "move":
                    self.events.append((round(t_s, 6), event.part, event.event, event.reason))

    def end(self) -> "Told":
        for part in self.engine.parts:
            record = self._watch.replayed(part)
            self.health.append((record["state"], record["faults"]))
        return self


def calibrated(config: Path, log: Path) -> Engine:
    settings, layout = load_skin(config)
    found = calibrate_from_log(log, settings, layout, 5.0)
    return Engine(settings, layout, list(range(len(layout.parts))), found)


def replayed(config: Path, log: Path) -> Told:
    told = Told(calibrated(config, log))
    for output in replay(log, told.engine):
        told.take(output)
    return told.end()


def as_live(config: Path, log: Path) -> Told:
    """The same frames, by a daemon's link that takes a turn each time it looks for silence."""
    told = Told(calibrated(config, log))
    link = Link(told.engine, open_port=StillPort)
    frames: list[tuple[int, str, int, bytes]] = []
    channels = {bus.channel: name for name, bus in told.engine.settings.buses.items()}
    for channel, batch in read_channels(log):
        for row in range(len(batch)):
            payload = batch.data[row, : batch.dlc[row]].tobytes()
            frames.append((int(batch.t_ns[row]), channels[channel], int(batch.id[row]), payload))
    frames.sort(key=lambda one: one[0])
    now_ns = T0_NS
    while frames:
        now_ns += EXPIRE_NS
        waiting = [one for one in frames if one[0] < now_ns]
        frames = frames[len(waiting) :]
        for name, port in link.ports.items():
            assert isinstance(port, StillPort)
            mine = [(can_id, data, t_ns) for t_ns, bus, can_id, data in waiting if bus == name]
            port.waiting.append(FrameBatch.of(mine))
        link.turn(now_ns, told.take)
    told.take(told.engine.flush())
    return told.end()


CASES = {
    "none": (none_stops, lambda _: 0.0),
    "stop": (stops, lambda _: 0.0),
    "back": (comes_back, lambda _: 0.0),
    "gap": (all_pause, lambda _: 0.0),
    "zeroed": (all_pause, zeroed),
}


@pytest.mark.parametrize("joined", [False, True], ids=["a part each", "one part"])
@pytest.mark.parametrize("buses", [1, 2])
@pytest.mark.parametrize("case", CASES)
def test_a_replay_reports_what_a_daemon_reports(
    case: str, buses: int, joined: bool, tmp_path: Path
) -> None:
    config, log = write(tmp_path, buses, *CASES[case], joined=joined)
    live, found = as_live(config, log), replayed(config, log)
    assert found.events == live.events
    assert found.contacts == live.contacts
    assert found.health == live.health


@pytest.mark.parametrize("buses", [1, 2])
def test_a_touch_of_skin_that_is_not_received_any_more_ends_as_lost(
    buses: int, tmp_path: Path
) -> None:
    config, log = write(tmp_path, buses, stops)
    found = replayed(config, log)
    assert [event[1:] for event in found.events] == [
        ("arm", "begin", None),
        ("arm", "end", "lost"),
    ]
    assert STOPS_S < found.events[-1][0] < STOPS_S + 2.0
    of_arm = [(t_s, state) for t_s, part, state in found.contacts if part == "arm"]
    assert of_arm[-1][1] == "UNKNOWN"
    assert STOPS_S < of_arm[-1][0] < STOPS_S + 0.5
    assert found.health[0][0] == "silent"
    assert found.health[1][0] == "ok"


def test_an_export_has_the_end_of_what_was_lost(tmp_path: Path) -> None:
    config, log = write(tmp_path, 2, stops)
    settings, layout = load_skin(config)
    series = read_frames(log, settings, layout, calibrate_from_log(log, settings, layout, 5.0))
    assert [(one.event, one.reason) for one in series.touches if one.event != "move"] == [
        ("begin", None),
        ("end", "lost"),
    ]
    assert [one.state for one in series.contacts if one.part == "arm"][-1] == "UNKNOWN"
    assert {line.part: line.state for line in series.health} == {"arm": "silent", "leg": "ok"}
    assert np.isnan(series.parts["arm"].pressure_kpa[-1]).all()


def test_a_part_that_was_never_received_has_no_frames_in_an_export(tmp_path: Path) -> None:
    config, log = write(tmp_path, 2, lambda number, _: number == 1)
    settings, layout = load_skin(config)
    series = read_frames(log, settings, layout, calibrate_from_log(log, settings, layout, 5.0))
    assert list(series.parts) == ["leg"]
    assert [one.state for one in series.contacts if one.part == "arm"] == ["UNKNOWN"]


@pytest.mark.parametrize("buses", [1, 2])
def test_a_gap_of_days_is_passed_over_at_once(buses: int, tmp_path: Path) -> None:
    """All boards are silent after a minute; the rest of the gap changes nothing."""
    config, log = write(tmp_path, buses, none_stops)
    lines = log.read_text().splitlines(keepends=True)

    def later(line: str) -> str:
        seconds = int(line[1 : line.index(".")])
        late = seconds >= T0_S + STOPS_S
        return line.replace(str(seconds), str(seconds + 30 * 86400 * late), 1)

    log.write_text("".join(map(later, lines)))
    engine = calibrated(config, log)
    outputs = list(replay(log, engine))
    assert len(outputs) < 2000
    ended = [event for output in outputs for event in output.events if event.event == "end"]
    assert [event.reason for event in ended] == ["lost", "released"]
    # It counts for what drifts meanwhile.
    assert engine.ledger.now_ns > 30 * 86400 * 10**9


def test_a_recording_that_is_damaged_is_processed_up_to_there(tmp_path: Path) -> None:
    config, log = write(tmp_path, 1, none_stops, last_s=8.0)
    engine = calibrated(config, log)
    with log.open("a") as file:
        file.write("damaged\n")
    received = 0
    with pytest.raises(LogError, match="damaged after frame"):
        for _, batch in read_buses(log, engine.settings):
            received += len(batch)
    with pytest.raises(LogError, match="damaged after frame"):
        list(timed(log, engine))
    assert engine.assemblers["can0"].counters.frames == received > 0
