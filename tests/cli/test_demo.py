"""The demo, as somebody runs it who has just cloned the project and has no mosquitto."""

import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from emulator.robot import Robot
from skin_host import demo
from skin_host.errors import SkinError
from skin_host.viewer.server import Viewer
from tests.support.broker import free_port
from tests.support.moments import at_import
from tests.support.waiting import PATIENCE_S

ROOT = Path(__file__).parents[2]
ENV = shutil.which("env")
#: In the command line of a process that multiprocessing starts.
CHILD = "--multiprocessing-fork"


def start(tmp_path, *options, env=os.environ):
    """The demo, where no program is installed."""
    script = "import sys, skin_host.mqtt.broker as broker; broker._MORE_PLACES = (); "
    script += "from skin_host.cli import main; sys.exit(main())"
    return subprocess.Popen(
        # What runs in the background ignores Ctrl-C, and so would all that it starts.
        [
            *(ENV, "--default-signal=INT", sys.executable, "-c", script),
            *("demo", "--page-port", "0", *options),
        ],
        cwd=ROOT,
        env=env | {"PATH": str(tmp_path)},
        start_new_session=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def test_the_demo_tells_touches_and_ends_with_a_summary_of_them(tmp_path):
    demo = start(tmp_path)
    assert demo.stdout is not None
    for line in demo.stdout:
        if line.split()[1:2] == ["end"]:
            break
    demo.send_signal(signal.SIGINT)
    out, err = demo.communicate(timeout=PATIENCE_S)
    assert demo.returncode == 0
    assert "Traceback" not in err
    # While the first calibration is being taken, that there is none is no news.
    assert "not calibrated" not in err
    summary = json.loads(out.splitlines()[-1])
    assert summary["broker"] == "amqtt"
    assert summary["sweeps"] > 100
    assert summary["frames_published"] > 50
    # On a busy machine the emulated robot is held up between two frames of a triangle; how often,
    # only the machine knows.
    assert 0 <= summary["frames_lost"] < summary["sweeps"]
    # What its broker has not taken in time at the end is given up.
    assert 1 <= summary["touches_ended"] <= summary["touches_begun"]
    assert summary["bus"] in {"socketpair", "socketcan"}


@pytest.mark.parametrize("number", ["SIGINT", "SIGTERM"])
@pytest.mark.parametrize(
    "module",
    ["multiprocessing.spawn", "numpy", "skin_host.demo", "emulator.robot", "emulator.chips.ad7147"],
)
def test_a_demo_whose_robot_is_being_started_ends_in_good_order(tmp_path, module, number):
    """Ctrl-C of a terminal reaches both processes, and so do the signals of some supervisors."""
    act = f"os.killpg(0, signal.{number})"
    demo = start(tmp_path, env=at_import(tmp_path, module, CHILD, act))
    out, err = demo.communicate(timeout=PATIENCE_S)
    assert demo.returncode == 0
    assert "Traceback" not in err
    assert json.loads(out.splitlines()[-1])["touches_begun"] == 0


def test_a_robot_whose_demo_was_killed_ends_without_a_word(tmp_path):
    act = "os.kill(os.getppid(), signal.SIGKILL)"
    demo = start(tmp_path, env=at_import(tmp_path, "emulator.robot", CHILD, act))
    out, err = demo.communicate(timeout=PATIENCE_S)  # its pipes end with the last process
    assert (demo.returncode, out, err) == (-signal.SIGKILL, "", "")


def test_the_demo_of_any_configuration_ends_by_itself(tmp_path):
    hand = str(ROOT / "config/icub_hand.toml")
    out, err = start(tmp_path, hand, "--duration", "1").communicate(timeout=PATIENCE_S)
    assert "skin/icub/+/touch" in out
    assert json.loads(out.splitlines()[-1])["touches_begun"] == 0
    assert "Traceback" not in err


async def test_where_the_usual_port_is_taken_the_page_is_at_another(monkeypatch):
    viewer = Viewer(f"mqtt://127.0.0.1:{free_port()}", robot="demo")
    async with demo.served(viewer, 0) as taken:
        port = int(taken.rstrip("/").rpartition(":")[2])
        monkeypatch.setattr(demo, "PAGE_PORT", port)
        async with demo.served(viewer, None) as elsewhere:
            assert elsewhere != taken
        with pytest.raises(SkinError, match="Address already in use; choose another port"):
            async with demo.served(viewer, port):
                pass


@pytest.mark.parametrize("name", ["icub", "fingertips", "kaspar"])
def test_the_scene_for_any_robot_presses_each_of_its_parts(name):
    settings, layout, scene = demo.prepared(demo.configuration(f"{name}.toml"), None)
    bare = {name for name, tip in settings.fingertips.items() if tip.array is None}
    assert {probe.part for probe in scene.probe} == {*settings.parts, *bare}
    # The robot is built with it: every place is one of the skin.
    Robot(settings, layout, scene)
    channels = {(bus.interface, bus.channel) for bus in settings.buses.values()}
    assert len(channels) == len(settings.buses)
    assert {interface for interface, _ in channels} == {"virtual"}
