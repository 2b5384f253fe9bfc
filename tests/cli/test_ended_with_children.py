"""Commands that start programs and make folders leave none, however the terminal ends them."""

import asyncio
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from skin_host.cli.common import leaving, run
from skin_host.mqtt.broker import find_mosquitto
from tests.support.waiting import PATIENCE_S

ROOT = Path(__file__).parents[2]
DEFAULT = ("env", "--default-signal=INT,TERM,HUP")
SIGNALS = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]


def start(folder: Path, *command: str) -> "subprocess.Popen[str]":
    """A command with a session of its own, whose temporary files are in `folder`."""
    return subprocess.Popen(
        [*DEFAULT, sys.executable, "-m", "skin_host", *command],
        cwd=ROOT,
        env=os.environ | {"TMPDIR": str(folder)},
        start_new_session=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def programs_of(folder: Path) -> list[str]:
    """Command lines of the programs that use a folder of temporary files."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            if f"TMPDIR={folder}\0".encode() in (process / "environ").read_bytes():
                found.append((process / "cmdline").read_text().replace("\0", " "))
        except OSError:  # of another user, or ended
            continue
    return found


def wait_for_programs(folder: Path, n: int) -> None:
    """Wait until all have started: the resource tracker of multiprocessing is one of them."""
    end_s = time.monotonic() + PATIENCE_S
    while len(programs_of(folder)) < n:
        assert time.monotonic() < end_s, programs_of(folder)
        time.sleep(0.05)


def leaves_nothing(folder: Path) -> None:
    """Zombies that nobody waits for have no environment any more."""
    end_s = time.monotonic() + PATIENCE_S
    while programs_of(folder):
        assert time.monotonic() < end_s, programs_of(folder)
        time.sleep(0.05)
    assert not list(folder.iterdir())


@pytest.mark.parametrize("number", SIGNALS, ids=lambda number: number.name)
def test_a_demo_whose_terminal_is_closed_leaves_nothing(
    tmp_path: Path, number: signal.Signals
) -> None:
    """A shell sends SIGHUP once more to what it has started."""
    demo = start(tmp_path, "demo", "--page-port", "0")
    assert demo.stdout is not None
    for line in demo.stdout:
        if line.startswith("Calibrating"):
            break
    os.killpg(demo.pid, number)
    if number == signal.SIGHUP:
        os.killpg(demo.pid, number)
    _, err = demo.communicate(timeout=PATIENCE_S)
    assert demo.returncode == 0, err
    assert "Traceback" not in err
    assert "failed" not in err
    leaves_nothing(tmp_path)


@pytest.mark.parametrize("number", SIGNALS, ids=lambda number: number.name)
@pytest.mark.parametrize(
    ("name", "programs"), [("receive", 4), ("latency", 6), ("daemon", 7), ("fleet", 7)]
)
def test_a_benchmark_that_is_ended_leaves_nothing(
    tmp_path: Path, name: str, programs: int, number: signal.Signals
) -> None:
    if name != "receive" and find_mosquitto() is None:
        pytest.skip("mosquitto is not installed")
    bench = start(tmp_path, "bench", name, "--quick")
    wait_for_programs(tmp_path, programs)
    os.killpg(bench.pid, number)
    out, err = bench.communicate(timeout=PATIENCE_S)
    assert bench.returncode == 128 + number, err
    assert out == ""
    assert "Traceback" not in err
    leaves_nothing(tmp_path)


def test_a_second_hangup_does_not_end_what_ends_in_good_order() -> None:
    if signal.SIGHUP not in leaving():
        pytest.skip("it is ignored here")
    before = signal.getsignal(signal.SIGHUP)

    async def work(stop: asyncio.Event) -> str:
        os.kill(os.getpid(), signal.SIGHUP)
        await stop.wait()
        for _ in range(3):
            os.kill(os.getpid(), signal.SIGHUP)
            await asyncio.sleep(0.01)
        return "ended"

    try:
        assert run(work) == "ended"
    finally:
        signal.signal(signal.SIGHUP, before)
