"""The service files: systemd finds nothing wrong with them, and little that is exposed."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.support import programs
from tests.support.broker import free_port
from tests.support.certificates import authority, certificate

ROOT = Path(__file__).parents[3]
UNIT = ROOT / "systemd" / "skin-host@.service"
MOST_EXPOSED = 13
MOST_EXPOSED_WITH_AN_ADAPTER = 15


def analyze(*arguments: str | Path) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(
        [programs.require("systemd-analyze"), *arguments],
        check=False,
        capture_output=True,
        text=True,
    )


@pytest.fixture
def installed_unit(tmp_path: Path) -> Path:
    """The unit with a program that exists here; the installation makes the real one."""
    unit = tmp_path / "skin-host@main.service"
    unit.write_text(UNIT.read_text().replace("/opt/skin-host/bin/skin", "/bin/true"))
    return unit


def test_the_unit_has_no_errors(installed_unit: Path) -> None:
    done = analyze("verify", "--man=no", installed_unit)
    assert done.returncode == 0
    assert done.stderr == ""


def test_the_unit_exposes_little(installed_unit: Path) -> None:
    done = analyze(
        "security", "--offline=true", "--no-pager", f"--threshold={MOST_EXPOSED}", installed_unit
    )
    assert done.returncode == 0, done.stdout


@pytest.mark.parametrize(
    ("drop_in", "devices"),
    [
        ("skin-host-serial.conf", ["char-ttyACM", "char-ttyUSB"]),
        ("skin-host-usb.conf", ["char-usb_device"]),
    ],
)
def test_an_adapter_that_is_no_network_interface_is_reached_by_a_drop_in_that_exposes_little_more(
    installed_unit: Path, drop_in: str, devices: list[str]
) -> None:
    folder = installed_unit.with_name(f"{installed_unit.name}.d")
    folder.mkdir()
    shutil.copy(ROOT / "systemd" / drop_in, folder)
    done = analyze("verify", "--man=no", installed_unit)
    assert (done.returncode, done.stderr) == (0, "")
    threshold = f"--threshold={MOST_EXPOSED_WITH_AN_ADAPTER}"
    done = analyze("security", "--offline=true", "--no-pager", threshold, installed_unit)
    assert done.returncode == 0, done.stdout
    (allowed,) = [line for line in done.stdout.splitlines() if "DeviceAllow=" in line]
    # A real-time clock may be read: that comes with the protection of the computer's clock.
    reached = set(re.findall(r"char-\w+:rw", allowed))
    assert reached == {f"{device}:rw" for device in devices}


def test_can_is_allowed_and_secrets_are_no_arguments() -> None:
    lines = UNIT.read_text().splitlines()
    (families,) = [line for line in lines if line.startswith("RestrictAddressFamilies=")]
    assert "AF_CAN" in families.split("=")[1].split()
    assert not [line for line in lines if "password" in line.lower() and "Exec" in line]


def test_installing_and_removing_leaves_the_configuration(tmp_path: Path) -> None:
    root = tmp_path / "root"
    run = ["make", "--no-print-directory"]
    extra = [f"DESTDIR={root}", "NO_VENV=1"]
    subprocess.run([*run, "install", *extra], cwd=ROOT, check=True, capture_output=True)
    assert (root / "etc/systemd/system/skin-host@.service").read_text() == UNIT.read_text()
    assert (root / "etc/systemd/network/80-skin-can.network").exists()
    own = root / "etc/skin-host/main.toml"
    own.write_text("robot = 'x'\n")
    enabled = root / "etc/systemd/system/multi-user.target.wants/skin-host@main.service"
    enabled.parent.mkdir()
    enabled.symlink_to("/etc/systemd/system/skin-host@.service")
    for added in ("system/skin-host@.service.d", "network/80-skin-can.network.d"):
        (root / "etc/systemd" / added).mkdir()
        (root / "etc/systemd" / added / "own.conf").write_text("")
    subprocess.run([*run, "uninstall", *extra], cwd=ROOT, check=True, capture_output=True)
    left = [path.relative_to(root) for path in root.rglob("*") if not path.is_dir()]
    assert left == [Path("etc/skin-host/main.toml")]


def test_the_interfaces_are_set_up_with_what_every_controller_takes() -> None:
    """A driver that does not know a setting refuses the bit rate with it."""
    lines = (ROOT / "systemd/80-skin-can.network").read_text().splitlines()
    assert lines[lines.index("[CAN]") + 1 :] == ["BitRate=1000000"]
    offered = {path.name for path in (ROOT / "systemd/80-skin-can.network.d").iterdir()}
    assert offered == {"restart.conf", "errors.conf"}


def test_mosquitto_takes_the_example_configuration_beside_its_own(tmp_path: Path) -> None:
    """Debian's main file, as it is but for its places, includes ours."""
    program = programs.require("mosquitto")
    folder = tmp_path / "conf.d"
    folder.mkdir()
    shutil.copy(ROOT / "systemd/mosquitto/skin.acl", tmp_path)
    (tmp_path / "skin.passwords").write_text("")
    authority(tmp_path, "ca")
    certificate(tmp_path, "server", "IP:127.0.0.1")
    text = (ROOT / "systemd/mosquitto/skin.conf").read_text()
    text = text.replace("/etc/mosquitto/certs/", f"{tmp_path}/")
    text = text.replace("/etc/mosquitto/", f"{tmp_path}/")
    text = text.replace("listener 1883 127.0.0.1", f"listener 0 {tmp_path}/socket")
    text = text.replace("listener 8883", f"listener {free_port()} 127.0.0.1")
    (folder / "skin.conf").write_text(text)
    main = Path("/etc/mosquitto/mosquitto.conf").read_text()
    for place in ("/run/mosquitto/", "/var/lib/mosquitto/", "/var/log/mosquitto/"):
        assert place in main
        main = main.replace(place, f"{tmp_path}/")
    main = main.replace("/etc/mosquitto/conf.d", str(folder))
    (tmp_path / "mosquitto.conf").write_text(f"user root\n{main}")
    try:
        done = subprocess.run(
            [program, "-c", tmp_path / "mosquitto.conf"],
            check=False,
            capture_output=True,
            text=True,
            timeout=2.0,
        )
    except subprocess.TimeoutExpired:
        assert (tmp_path / "socket").exists()
        return  # it runs
    pytest.fail(done.stderr + (tmp_path / "mosquitto.log").read_text())
