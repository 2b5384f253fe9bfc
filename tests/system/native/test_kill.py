"""kill -9 at random moments: no damaged file, and back to publishing soon.

`KILL_ROUNDS=200` is the full length.
"""

import json
import logging
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from skin_host.config.settings import load, skin_hash
from skin_host.daemon.state import NodeState
from skin_host.layout import build_layout
from skin_host.processing.calibration.file import load_calibration
from tests.support.broker import Mosquitto
from tests.support.programs import require

ROOT = Path(__file__).parents[3]
ROUNDS = int(os.environ.get("KILL_ROUNDS", "6"))
BACK_S = 2.0
#: Starting Python and importing numpy, on this machine, is no part of what is promised.
GRACE_S = float(os.environ.get("KILL_GRACE_S", "4.0"))


def configure(folder: Path, port: int) -> Path:
    text = (ROOT / "config/demo.toml").read_text()
    text += f'\n[mqtt]\nport = {port}\n[service]\nstate_directory = "{folder}/state"\n'
    text += "[processing.calibration]\nseconds = 0.6\n"
    config = folder / "demo.toml"
    config.write_text(text)
    return config


def start(config: Path) -> "subprocess.Popen[bytes]":
    """Robot and daemon in one process: SIGKILL takes both, as a loss of power would."""
    return subprocess.Popen(
        [
            sys.executable,
            "-m",
            "tests.support.one_process",
            str(config),
            "--",
            "run",
            str(config),
        ],
        cwd=ROOT,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


def first_frame_s(port: int, limit_s: float) -> float | None:
    began_s = time.monotonic()
    heard = subprocess.run(
        [
            require("mosquitto_sub"),
            "-p",
            str(port),
            "-t",
            "skin/demo/+/frame",
            "-C",
            "1",
            "-W",
            str(int(limit_s)),
        ],
        check=False,
        capture_output=True,
    )
    return time.monotonic() - began_s if heard.stdout else None


def test_kill_9_at_any_moment_damages_nothing(mosquitto: Mosquitto, tmp_path: Path) -> None:
    config = configure(tmp_path, mosquitto.port)
    settings = load(config)
    layout = build_layout(settings, tmp_path)
    state = tmp_path / "state"
    seed = random.Random(4)
    back_s: list[float] = []
    for number in range(ROUNDS + 1):
        process = start(config)
        try:
            came_s = first_frame_s(mosquitto.port, BACK_S + GRACE_S + 4.0)
            assert came_s is not None, f"round {number}: nothing was published"
            if number:  # the first start takes a calibration
                back_s.append(came_s)
            # Files are being written while it dies: a calibration, and operators' changes.
            for name, request in (
                ("calibrate", {"seconds": 0.1}),
                ("thresholds", {"set": {"margin_units": float(number + 1)}}),
            ):
                subprocess.run(
                    [
                        require("mosquitto_pub"),
                        "-p",
                        str(mosquitto.port),
                        "-q",
                        "1",
                        "-t",
                        f"skin/demo/nodes/main/cmd/{name}",
                        "-m",
                        json.dumps(request),
                    ],
                    check=True,
                )
            time.sleep(seed.uniform(0.0, 0.4))
        finally:
            process.send_signal(signal.SIGKILL)
            process.wait()
        load_calibration(state / "demo-main.calibration.json", layout, skin_hash(settings))
        kept = state / "demo-main.state.json"
        if kept.exists():
            content = json.loads(kept.read_bytes())
            assert content["schema"] == NodeState().schema
            assert set(content) == set(NodeState.__struct_fields__)
    assert len(back_s) == ROUNDS
    soon = sum(back <= BACK_S for back in back_s)
    logging.info(
        "%d kills; publishing after %.2f to %.2f s, %d times within %g s",
        *(ROUNDS, min(back_s), max(back_s), soon, BACK_S),
    )


@pytest.mark.parametrize("damage", [b"", b"{", b"\xff" * 100, b'{"schema":"other"}'])
def test_a_damaged_file_is_told_of_and_stops_nothing(
    mosquitto: Mosquitto, tmp_path: Path, damage: bytes
) -> None:
    config = configure(tmp_path, mosquitto.port)
    (tmp_path / "state").mkdir()
    (tmp_path / "state/demo-main.calibration.json").write_bytes(damage)
    (tmp_path / "state/demo-main.state.json").write_bytes(damage)
    process = start(config)
    try:
        assert first_frame_s(mosquitto.port, 12.0) is not None
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
