"""A machine that the project was installed on as its documentation says, by its own files."""

from collections.abc import Iterator
from contextlib import closing

import pytest

from tests.support.machine import ROOT, Done, Machine
from tests.support.service import PIP, ROBOT, Service


@pytest.fixture(scope="session")
def machine(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Machine]:
    """A Debian that has just booted, with a virtual CAN bus and a broker."""
    with closing(Machine("uml", tmp_path_factory.mktemp("machine"))) as made:
        made.write("/etc/systemd/network/10-vcan0.netdev", "[NetDev]\nName=vcan0\nKind=vcan\n")
        made.write("/etc/systemd/network/10-vcan0.network", "[Match]\nName=vcan0\n")
        made.do("networkctl reload")
        made.write("/etc/systemd/system/robot.service", ROBOT)
        made.do(f"mkdir -p /host && mount -t hostfs -o {ROOT} none /host")
        left_out = " ".join(
            f"--exclude=./{name}" for name in (".git", ".venv", ".lane", ".*_cache")
        )
        made.do(f"mkdir skin-host && tar -C /host {left_out} -c . | tar -C skin-host -x", 300.0)
        made.do("cp -r /host/.lane/wheels /root/wheels && umount /host")
        yield made


@pytest.fixture(scope="session")
def installed(machine: Machine) -> Done:
    """How `make install` went."""
    return machine.run(f"{PIP} make -C skin-host install", 600.0)


@pytest.fixture
def service(machine: Machine, installed: Done) -> Service:
    """The service at work: calibrated, its robot and its broker there, nothing wrong."""
    assert installed.status == 0, installed.output
    made = Service(machine)
    made.set_right()
    return made
