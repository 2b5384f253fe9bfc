"""What a subscriber's program loads with the client."""

import subprocess
import sys

#: What the daemon and the emulator need, and a subscriber of touches never does.
HEAVY = {"numpy", "can", "smbus2", "emulator", "fastapi", "aiohttp", "matplotlib", "mcap"}
#: Packages of ours that the client is made of.
OURS = {
    "client",
    "clock",
    "config",
    "errors",
    "files",
    "fingertip",
    "mqtt",
    "processing",
    "tasks",
    "untrusted",
}
MOST_MODULES = 240

PROGRAM = """
import sys
before = set(sys.modules)
import skin_host.client
from skin_host.client.heard import read

assert read("contact", "hand", b"ON")
touch = '''{"schema": "skin.touch/1", "event": "begin", "id": 1, "seq": 1, "t_ns": 1,
    "part": "hand", "taxels": [3], "centroid_m": null, "normal": null, "area_mm2": 20.0,
    "peak_kpa": 9.0, "mean_kpa": 9.0, "force_n": 0.2}'''
assert read("touch", "hand", touch.encode())
print(*sorted(set(sys.modules) - before))
"""


def test_a_subscriber_of_touches_loads_neither_numpy_nor_the_daemon() -> None:
    command = [sys.executable, "-c", PROGRAM]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    loaded = done.stdout.split()
    assert not {name.split(".")[0] for name in loaded} & HEAVY
    ours = {name.split(".")[1] for name in loaded if name.startswith("skin_host.")}
    assert ours <= OURS
    assert "skin_host.config.settings" not in loaded
    assert len(loaded) <= MOST_MODULES
