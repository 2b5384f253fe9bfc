"""A virtual CAN interface of the kernel that a test can take down, remove and bring back."""

import itertools
import subprocess


class Vcan:
    """One vcan interface under the first free name. Needs root and the kernel's vcan."""

    def __init__(self) -> None:
        for number in itertools.count():
            self.name = f"vcan{number}"
            try:
                self.add()
            except FileExistsError:
                continue
            return

    def add(self) -> None:
        """Make the interface, and bring it up; raise FileExistsError if its name is taken."""
        _ip("link", "add", "dev", self.name, "type", "vcan")
        self.up()

    def remove(self) -> None:
        """Take the interface away, as pulling a USB adapter does."""
        _ip("link", "del", "dev", self.name)

    def up(self) -> None:
        """Let frames pass."""
        _ip("link", "set", self.name, "up")

    def down(self) -> None:
        """Let no frame pass."""
        _ip("link", "set", self.name, "down")

    def close(self) -> None:
        """Remove the interface if it is still there."""
        subprocess.run(["ip", "link", "del", "dev", self.name], check=False, capture_output=True)


def _ip(*arguments: str) -> None:
    done = subprocess.run(["ip", *arguments], check=False, capture_output=True, text=True)
    if "File exists" in done.stderr:
        raise FileExistsError(done.stderr)
    if done.returncode != 0:
        raise RuntimeError(
            f"'ip {' '.join(arguments)}' failed: {done.stderr.strip()}; "
            "where the kernel has no vcan, run the tests by tools/lane/run"
        )
