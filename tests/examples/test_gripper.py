"""The gripper's example with a real daemon, an emulator under MuJoCo and a broker."""

import asyncio
import sys
from pathlib import Path

import can
import pytest

from tests.support.broker import Mosquitto

ROOT = Path(__file__).parents[2]
PATIENCE_S = 120.0
GROUP = "239.74.163.211"


async def test_the_gripper_closes_until_both_fingers_are_touched(
    mosquitto: Mosquitto, tmp_path: Path
) -> None:
    pytest.importorskip("mujoco")
    try:
        can.Bus(interface="udp_multicast", channel=GROUP).shutdown()
    except (can.CanError, OSError):
        pytest.skip("this machine has no network for multicast")
    config = tmp_path / "gripper.toml"
    text = (ROOT / "config" / "gripper.toml").read_text().replace("239.74.163.7", GROUP)
    config.write_text(
        f'{text}\n[mqtt]\nhost = "{mosquitto.host}"\nport = {mosquitto.port}\n'
        f'[service]\nstate_directory = "{tmp_path}"\nmetrics_port = 0\n'
        "[processing.calibration]\nseconds = 2\n"
    )
    url = f"mqtt://{mosquitto.host}:{mosquitto.port}"
    example = await asyncio.create_subprocess_exec(
        *(sys.executable, "-u", ROOT / "examples" / "gripper.py", url, config),
        cwd=ROOT,
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
    )
    daemon = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "skin_host", "run", config, "--calibrate"), cwd=ROOT
    )
    told: list[str] = []
    try:
        assert example.stdout is not None
        async with asyncio.timeout(PATIENCE_S):
            while "it holds" not in told:
                told.append((await example.stdout.readline()).decode().strip())
                assert told[-1]
    except TimeoutError:
        pytest.fail(f"after {PATIENCE_S:g} s it has said only {told}")
    finally:
        if "it holds" in told:
            assert example.stdin is not None
            example.stdin.close()
        else:
            example.terminate()
        await example.wait()
        daemon.terminate()
        await daemon.wait()
    assert {"left closes", "right closes", "left stops: touched", "right stops: touched"} <= {*told}
    closing = [told.index(f"{finger} closes") for finger in ("left", "right")]
    assert max(closing) < told.index("it holds")
