"""The shipped examples at work: a broker on the robot, bridged to one outside over TLS.

The link between the two is cut and healed; BRIDGE_CUTS sets how often. The robot's own
subscribers miss nothing, and those outside learn of everything late, or that it was lost.
"""

import json
import logging
import os
import random
import subprocess
import sys
import time
from collections import Counter
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path

from tests.support.certificates import authority, certificate
from tests.support.netns import HERE, THERE, THERE_ADDRESS, Process, cable, two_computers
from tests.support.programs import require

ROOT = Path(__file__).parents[3]
EXAMPLES = ROOT / "systemd/mosquitto"
CUTS = int(os.environ.get("BRIDGE_CUTS", "1"))
#: `keepalive_interval` of bridge.conf; a broker waits half as long again.
KEEPALIVE_S = 10
USERS = {"skin-host": "s3cret", "viewer": "look", "operator": "press"}
OUTSIDE = "robot", "uplink"
PERIOD_S = 0.05
TOUCH = "skin/demo/+/touch"


def passwords(path: Path, users: dict[str, str]) -> None:
    path.touch()
    for name, word in users.items():
        command = [require("mosquitto_passwd"), "-b", str(path), name, word]
        subprocess.run(command, check=True, capture_output=True)


def on_the_robot(folder: Path) -> Path:
    """skin.conf with bridge.conf, as they are but for places, address and password."""
    text = (EXAMPLES / "skin.conf").read_text() + (EXAMPLES / "bridge.conf").read_text()
    for shipped, here in (
        ("/etc/mosquitto/certs/fleet-ca.crt", f"{folder}/ca.crt"),
        ("/etc/mosquitto/certs/", f"{folder}/"),
        ("/etc/mosquitto/", f"{folder}/"),
        ("broker.example:8883", f"{THERE_ADDRESS}:8883"),
        ("#remote_username robot", f"remote_username {OUTSIDE[0]}"),
        ("#remote_password ...", f"remote_password {OUTSIDE[1]}"),
    ):
        assert shipped in text
        text = text.replace(shipped, here)
    (folder / "skin.acl").write_text((EXAMPLES / "skin.acl").read_text())
    passwords(folder / "skin.passwords", USERS)
    path = folder / "robot.conf"
    # As Debian's main file has it.
    kept = f"persistence true\npersistence_location {folder}/\n"
    path.write_text(f"user root\n{kept}{text}")
    return path


def outside(folder: Path) -> Path:
    """A broker of a fleet: TLS and a password for robots, open to its own machine."""
    passwords(folder / "fleet.passwords", dict([OUTSIDE]))
    path = folder / "fleet.conf"
    path.write_text(
        "user root\nper_listener_settings true\npersistence false\n"
        "listener 1883 127.0.0.1\nallow_anonymous true\n"
        f"listener 8883\nallow_anonymous false\npassword_file {folder}/fleet.passwords\n"
        f"cafile {folder}/ca.crt\ncertfile {folder}/fleet.crt\nkeyfile {folder}/fleet.key\n"
    )
    return path


def robot_configuration(folder: Path) -> Path:
    (folder / "password").write_text(USERS["skin-host"])
    text = (ROOT / "config/demo.toml").read_text()
    text += '\n[mqtt]\nhost = "127.0.0.1"\nusername = "skin-host"\n'
    text += f'password_file = "{folder}/password"\n[service]\nstate_directory = "{folder}/state"\n'
    text += "[processing.calibration]\nseconds = 0.6\n[processing.touch]\nmove_hz = 5\n"
    path = folder / "demo.toml"
    path.write_text(text)
    return path


def touches(lines: list[str]) -> dict[tuple[str, int], str]:
    """What came, by part and number: at least once is more than once, sometimes."""
    found = [json.loads(line.split(" ", 1)[1]) for line in lines if "/touch " in line]
    return {(one["part"], one["count"]): one["event"] for one in found}


def test_a_cut_uplink_is_not_felt_on_the_robot_and_heals_by_itself(tmp_path: Path) -> None:
    authority(tmp_path, "ca")
    for name, address in (("server", "127.0.0.1"), ("fleet", THERE_ADDRESS)):
        certificate(tmp_path, name, f"IP:{address}")
    mosquitto = require("mosquitto")
    with two_computers(), ExitStack() as stack:
        Process(stack, THERE, tmp_path / "fleet", mosquitto, "-c", str(outside(tmp_path)))
        Process(stack, HERE, tmp_path / "robot", mosquitto, "-c", str(on_the_robot(tmp_path)))
        time.sleep(1.0)
        listen = (require("mosquitto_sub"), "-h", "127.0.0.1", "-v", "-q", "1")
        viewer = (*listen, "-u", "viewer", "-P", USERS["viewer"])
        near = Process(
            stack, HERE, tmp_path / "near", *viewer, "-t", TOUCH, "-t", "skin/demo/left_hand/frame"
        )
        far = Process(stack, THERE, tmp_path / "far", *listen, "-t", TOUCH)
        link = Process(stack, THERE, tmp_path / "link", *listen, "-t", "$SYS/broker/connection/#")
        config = str(robot_configuration(tmp_path))
        run = (sys.executable, "-m", "tests.support.one_process", config)
        scene = str(ROOT / "config/scenes/demo.toml")
        Process(stack, HERE, tmp_path / "daemon", *run, scene, "--", "run", config)
        far.wait_for("/touch", 40.0)
        link.wait_for("/state 1", 10.0)
        chance = random.Random(3)
        for _ in range(CUTS):
            since = len(link.lines())
            cable(up=False)
            link.wait_for("/state 0", 1.5 * KEEPALIVE_S + 6.0, since)
            time.sleep(chance.uniform(0.0, 3.0))
            since = len(link.lines())
            cable(up=True)
            link.wait_for("/state 1", 45.0, since)
        # What waited has come when something newer has.
        known = max(number for _, number in touches(near.lines()))
        deadline_s = time.monotonic() + 30.0
        while max(number for _, number in touches(far.lines())) <= known:
            assert time.monotonic() < deadline_s, far.lines()[-3:]
            time.sleep(0.1)
        here, there = touches(near.lines()[:-1]), touches(far.lines()[:-1])
        frames = [
            json.loads(line.split(" ", 1)[1])["seq"]
            for line in near.lines()[:-1]
            if "/frame " in line
        ]
    logging.info("%d cuts; %d touch events here, %d there", CUTS, len(here), len(there))
    for part in {part for part, _ in here}:
        numbers = [number for owner, number in sorted(here) if owner == part]
        assert numbers == list(range(1, len(numbers) + 1))
    # A busy machine may skip a frame for a newer one; the cuts of many seconds must not show.
    gaps = [after - before for before, after in pairwise(frames)]
    assert max(gaps) * PERIOD_S < 0.5 * KEEPALIVE_S
    # What is newest of a part may still be on its way.
    newest = {part: max(number for owner, number in there if owner == part) for part, _ in there}
    missing = [key for key in here if key[1] <= newest.get(key[0], 0) and key not in there]
    assert not missing, f"{len(missing)} of {len(here)}: {Counter(here[key] for key in missing)}"
