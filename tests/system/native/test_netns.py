"""One robot on two computers, each its own network namespace; the cable between them is cut.

NETNS_CUTS sets how often.
"""

import json
import os
import random
import sys
import time
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path

from tests.support.netns import HERE, HERE_ADDRESS, THERE, Process, cable, two_computers
from tests.support.programs import require

ROOT = Path(__file__).parents[3]
CUTS = int(os.environ.get("NETNS_CUTS", "1"))
KEEPALIVE_S = 5
#: A broker waits for one and a half times that (MQTT 5, section 3.1.2.10); mosquitto looks every
#: five seconds, by a clock of whole ones.
OFFLINE_S = 1.5 * KEEPALIVE_S + 6.0
BROKER = HERE_ADDRESS


def configuration(folder: Path, name: str) -> Path:
    """The demo's robot; its forearm belongs to the second node."""
    text = (ROOT / "config/demo.toml").read_text()
    text += f'\n[parts.left_forearm]\nnode = "second"\n[mqtt]\nhost = "{BROKER}"\n'
    text += f"keepalive_s = {KEEPALIVE_S}\n"
    text += f'[service]\nstate_directory = "{folder}/{name}"\n'
    text += "[processing.calibration]\nseconds = 0.6\n"
    # A table and its array of tables: the table's own keys come first in TOML.
    head, _, rest = text.partition("[[parts.left_forearm.patches]]")
    rest = rest.replace('[parts.left_forearm]\nnode = "second"\n', "")
    text = f'{head}[parts.left_forearm]\nnode = "second"\n[[parts.left_forearm.patches]]{rest}'
    path = folder / f"{name}.toml"
    path.write_text(text)
    return path


def test_a_cut_cable_hurts_only_the_far_side(tmp_path: Path) -> None:
    with two_computers(), ExitStack() as stack:
        conf = tmp_path / "mosquitto.conf"
        conf.write_text(f"listener 1883 {BROKER}\nallow_anonymous true\nuser root\n")
        Process(stack, HERE, tmp_path / "broker", require("mosquitto"), "-c", str(conf))
        time.sleep(0.5)
        run = (sys.executable, "-m", "tests.support.one_process")
        for namespace, node in ((HERE, "main"), (THERE, "second")):
            config = str(configuration(tmp_path, node))
            arguments = (*run, config, "--", "run", config, "--node", node)
            Process(stack, namespace, tmp_path / f"{node}.log", *arguments)
        listen = (require("mosquitto_sub"), "-h", BROKER, "-v", "-q", "1")
        states = Process(
            stack, HERE, tmp_path / "states", *listen, "-t", "skin/demo/nodes/+/status"
        )
        near = Process(stack, HERE, tmp_path / "near", *listen, "-t", "skin/demo/left_hand/frame")
        far = Process(stack, HERE, tmp_path / "far", *listen, "-t", "skin/demo/left_forearm/frame")
        near.wait_for("left_hand/frame", 20.0)
        far.wait_for("left_forearm/frame", 20.0)
        seed = random.Random(2)
        for _ in range(CUTS):
            known = len(states.lines())
            cable(up=False)
            states.wait_for("nodes/second/status offline", OFFLINE_S, known)
            time.sleep(seed.uniform(0.0, 2.0))
            cable(up=True)
            since, frames = len(states.lines()), len(far.lines())
            states.wait_for("nodes/second/status online", 15.0, since)
            far.wait_for("left_forearm/frame", 5.0, frames)
        frames_here = [json.loads(line.split(" ", 1)[1]) for line in near.lines()[:-1]]
    numbers = [frame["seq"] for frame in frames_here]
    gaps = [after - before for before, after in pairwise(numbers)]
    # A busy machine may skip a frame for a newer one; the cuts of seconds must not show.
    assert max(gaps) <= 10
    assert sum(gap - 1 for gap in gaps) < 0.05 * len(numbers)
    assert len(numbers) > 100
