"""A gripper that closes until it feels something. `python examples/gripper.py [URL]`.

It moves a simulated gripper, whose daemon (`skin run config/gripper.toml`) publishes to the
broker. Each finger stops by itself when its skin is touched, or when that is not known.
"""

import signal
import subprocess
import sys
import threading
from pathlib import Path

from skin_host.client import Contact, SkinCallbacks, SkinError

ROOT = Path(__file__).parents[1]
CONFIG = ROOT / "config" / "gripper.toml"
MODEL = ROOT / "config" / "scenes" / "gripper.xml"
FINGERS = ("left", "right")
CLOSING_M_S = 0.01


class Gripper:
    """The motors: speeds are lines on the emulator's standard input."""

    def __init__(self, config: Path) -> None:
        skin = Path(sys.executable).parent / "skin"
        self._emulator = subprocess.Popen(
            [skin, "emulate", config, "--mujoco", MODEL],
            stdin=subprocess.PIPE,
            text=True,
            start_new_session=True,  # Ctrl-C is for this program, which then ends that one
        )

    def move(self, finger: str, speed_m_s: float) -> None:
        """Let a finger close at a speed from now on."""
        assert self._emulator.stdin is not None
        print(f"ctrl {finger} {speed_m_s}", file=self._emulator.stdin, flush=True)

    def close(self) -> None:
        """Switch it off."""
        self._emulator.terminate()
        self._emulator.wait()


def main(url: str = "mqtt://localhost", config: str = str(CONFIG)) -> None:
    """Close both fingers on what is between them."""
    for number in (signal.SIGTERM, signal.SIGHUP):  # else nothing would end the emulator
        signal.signal(number, lambda number, _: sys.exit(128 + number))
    gripper = Gripper(Path(config))
    touched = {finger: threading.Event() for finger in FINGERS}

    def on_contact(contact: Contact) -> None:
        finger = contact.part.removesuffix("_finger")
        closing = not (contact.touched or touched[finger].is_set())
        gripper.move(finger, CLOSING_M_S if closing else 0.0)
        print(finger, "closes" if closing else f"stops: {contact.why or 'touched'}", flush=True)
        if contact.touched and not contact.why:
            touched[finger].set()

    try:
        with SkinCallbacks(url, robot="gripper", patience_s=60) as skin:
            skin.on_contact(on_contact)
            for event in touched.values():
                event.wait()
            print("it holds", flush=True)
            sys.stdin.read()
    except SkinError as error:  # no broker, or one that refuses us
        sys.exit(str(error))
    except KeyboardInterrupt:
        pass
    finally:
        gripper.close()


if __name__ == "__main__":
    main(*sys.argv[1:])
