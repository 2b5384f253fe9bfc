"""A real recording of a real hand, through the whole pipeline by the command line."""

import io
import json
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import can
import numpy as np
import pytest

from skin_host.bus.logs import WINDOW_NS
from skin_host.config.settings import load
from skin_host.layout import build_layout
from skin_host.processing.core import Engine
from skin_host.recording import replay as processing

ROOT = Path(__file__).parents[2]
LOG = ROOT / "../shared/data/icub_grasp.log"
UNTOUCHED_S = 6.0

pytestmark = pytest.mark.skipif(not LOG.exists(), reason=f"no recording at {LOG}")


def replay() -> bytes:
    command = [sys.executable, "-m", "skin_host", "replay", str(LOG)]
    command += ["--config", str(ROOT / "config/icub_hand.toml"), "--output", "-"]
    return subprocess.run(command, check=True, capture_output=True).stdout


@pytest.fixture(scope="module")
def output() -> bytes:
    return replay()


@pytest.fixture(scope="module")
def frames(output: bytes) -> list[dict]:
    return [line for line in map(json.loads, output.splitlines()) if line["type"] == "frame"]


@pytest.fixture(scope="module")
def recorded() -> tuple[np.ndarray, np.ndarray]:
    """Bytes [sweep, finger, taxel] and the time of each sweep's last frame, read independently."""
    by_cycle: dict[int, np.ndarray] = {}
    last_ns: dict[int, int] = {}
    for message in can.LogReader(LOG):
        t_ns = round(message.timestamp * 1e6) * 1000
        cycle = (t_ns - 1_700_000_000_000_000_000 + 10_000_000) // 50_000_000
        values = by_cycle.setdefault(cycle, np.full((5, 12), -1))
        finger = message.arbitration_id & 0xF
        if message.data[0] == 0x40:
            values[finger, :7] = list(message.data[1:])
        else:
            values[finger, 7:] = list(message.data[1:6])
        last_ns[cycle] = t_ns
    cycles = sorted(by_cycle)
    return np.array([by_cycle[c] for c in cycles]), np.array([last_ns[c] for c in cycles])


def test_a_candump_log_is_replayed_without_what_it_does_not_need(tmp_path: Path) -> None:
    script = "import sys; from skin_host.cli import main; main(sys.argv[1:]); "
    script += "print(*{'can', 'aiomqtt', 'asyncio', 'multiprocessing'} & set(sys.modules))"
    command = [sys.executable, "-c", script, "replay", str(LOG)]
    command += ["--config", str(ROOT / "config/icub_hand.toml")]
    command += ["--output", str(tmp_path / "grasp.jsonl")]
    ran = subprocess.run(command, check=True, capture_output=True, text=True)
    assert ran.stdout.split() == []


def test_how_many_frames_are_taken_at_once_changes_no_byte(output: bytes, monkeypatch) -> None:
    monkeypatch.setattr(processing, "LONG_WINDOW_NS", WINDOW_NS)
    settings = load(ROOT / "config/icub_hand.toml")
    layout = build_layout(settings, ROOT / "config")
    found = processing.calibration_for(LOG, settings, layout, None, None)
    lines = io.BytesIO()
    processing.write_lines(LOG, Engine(settings, layout, [0], found), lines)
    assert lines.getvalue() == output


def test_every_recorded_byte_arrives_in_one_frame_a_sweep(frames, recorded):
    values, last_ns = recorded
    assert [frame["seq"] for frame in frames] == list(range(len(values)))
    assert [frame["t_ns"] for frame in frames] == last_ns.tolist()
    raw = np.array([frame["raw"] for frame in frames])
    assert raw.shape == (len(values), 108)
    np.testing.assert_array_equal(raw[:, :60].reshape(-1, 5, 12), values)


def test_the_palm_that_was_not_there_is_not_valid_and_the_fingers_are(frames):
    valid = np.array([frame["valid"] for frame in frames])
    assert valid[3:, :60].all()
    # A chip shows that it lives by two changes of its bytes.
    assert not valid[0].any()
    assert not valid[:, 60:].any()


def test_the_hand_is_touched_thirteen_times_and_never_before_the_first_grasp(frames):
    start_ns = frames[0]["t_ns"]
    touched = [any(frame["touched"]) for frame in frames]
    begins = [
        (after["t_ns"] - start_ns) * 1e-9
        for (before, after), (was, now) in zip(pairwise(frames), pairwise(touched), strict=True)
        if now and not was
    ]
    assert len(begins) == 13
    assert begins[0] >= UNTOUCHED_S


def test_every_touch_that_begins_ends(output):
    events = [line for line in map(json.loads, output.splitlines()) if line["type"] == "touch"]
    alive: set[int] = set()
    for event in events:
        if event["event"] == "begin":
            assert event["id"] not in alive
            alive.add(event["id"])
        else:
            assert event["id"] in alive
            if event["event"] == "end":
                alive.remove(event["id"])
    assert not alive
    assert all(taxel < 60 for event in events for taxel in event["taxels"])


def test_a_replay_is_the_same_to_the_byte_every_time(output):
    assert replay() == output


def test_the_health_at_the_end_names_what_is_missing(output):
    health = json.loads(output.splitlines()[-1])
    assert health["type"] == "health"
    assert {(one["triangle"], one["fault"]) for one in health["triangles"]} == {
        (number, "missing") for number in (8, 9, 10, 11)
    }
