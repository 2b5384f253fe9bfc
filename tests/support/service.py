"""skin-host@main on a booted machine, with an emulated robot, and what it is set to."""

import re

from tests.support.machine import ROOT, Machine

#: The machine has no network: what pip fetches lies there already.
PIP = "PIP_NO_INDEX=1 PIP_FIND_LINKS=/root/wheels"
UNIT = "skin-host@main"
CONFIGURATION = "/etc/skin-host/main.toml"
DROP_INS = "/etc/systemd/system/skin-host@.service.d"
STATE = "/var/lib/private/skin-host"
ROBOT = f"""
[Unit]
After=network.target
StartLimitIntervalSec=0
[Service]
ExecStart=/usr/local/bin/skin emulate {CONFIGURATION}
Restart=always
RestartSec=1
[Install]
WantedBy=multi-user.target
"""


class Service:
    """The unit under test, and the robot and the broker that it works with."""

    def __init__(self, machine: Machine) -> None:
        self.machine = machine

    def show(self, *keys: str) -> list[str]:
        """Properties of the unit."""
        wanted = " ".join(f"-p {key}" for key in keys)
        lines = self.machine.do(f"systemctl show {wanted} {UNIT}").splitlines()
        found = dict(line.split("=", 1) for line in lines)
        return [found[key] for key in keys]

    @property
    def pid(self) -> int:
        return int(self.show("MainPID")[0])

    @property
    def state(self) -> str:
        """Such as "active running success"."""
        return " ".join(self.show("ActiveState", "SubState", "Result"))

    @property
    def active(self) -> bool:
        return self.show("ActiveState") == ["active"]

    @property
    def status(self) -> str:
        """Its status line."""
        return self.show("StatusText")[0]

    def journal(self, since: str, *options: str) -> str:
        """What its journal has from a time on, see `machine.now`."""
        return self.machine.do(
            f"journalctl --no-pager -o cat -u {UNIT} --since={since} " + " ".join(options)
        )

    def configure(self, channel: str = "vcan0", more: str = "") -> None:
        """Write the demo's robot on a CAN interface as the configuration of `main`."""
        text = (ROOT / "config/demo.toml").read_text()
        text = re.sub(r'interface = ".*"', 'interface = "socketcan"', text)
        text = re.sub(r'channel = ".*"', f'channel = "{channel}"', text)
        # The machine has one processor.
        text = text.replace('bus = "can0"\naddress', 'bus = "can0"\nperiod_ms = 100\naddress')
        text += '\n[mqtt]\nhost = "127.0.0.1"\n\n[processing.calibration]\nseconds = 2.0\n'
        self.machine.write(CONFIGURATION, text + more)

    def set_right(self) -> None:
        """Let everything run as it should, whatever was done to it before."""
        before = self.machine.run(f"cat {CONFIGURATION}").output
        self.configure()
        after = self.machine.do(f"cat {CONFIGURATION}")
        stop = "" if before.strip() == after else f"systemctl stop robot {UNIT};"
        self.machine.do(
            f"test ! -e {DROP_INS} || {{ rm -r {DROP_INS}; systemctl daemon-reload; }}; "
            f"{stop} systemctl reset-failed; systemctl start mosquitto robot {UNIT}"
        )
        self.machine.until(self.works, "the service does not work")

    def works(self) -> bool:
        """Whether frames come, with a calibration, to a broker."""
        state, status = self.show("ActiveState", "StatusText")
        frames = re.match(r"(\d+) frames/s", status)
        return (
            state == "active"
            and frames is not None
            and int(frames[1]) > 0
            and "broker connected" in status
            and bool(self.calibration())
        )

    def calibration(self) -> str:
        """The sum of the calibration's file; empty without one."""
        done = self.machine.run(f"sha256sum {STATE}/demo-main.calibration.json")
        return done.output if done.status == 0 else ""

    def restarted(self, before: int) -> bool:
        """Whether another process than that of before is ready."""
        state, pid = self.show("ActiveState", "MainPID")
        return state == "active" and int(pid) not in {0, before}
