"""The service files: systemd finds nothing wrong with them, and little that is exposed."""

import subprocess
from pathlib import Path

import pytest

from tests.support import programs

ROOT = Path(__file__).parents[3]
UNIT = ROOT / "systemd" / "skin-host@.service"
MOST_EXPOSED = 15


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
    subprocess.run([*run, "uninstall", *extra], cwd=ROOT, check=True, capture_output=True)
    left = [path.relative_to(root) for path in root.rglob("*") if not path.is_dir()]
    assert left == [Path("etc/skin-host/main.toml")]


def test_the_link_and_network_files_name_keys_that_systemd_knows() -> None:
    text = (ROOT / "systemd/80-skin-can.network").read_text()
    assert "BitRate=1000000" in text
    assert "RestartSec=" in text


def test_mosquitto_takes_the_example_configuration(tmp_path: Path) -> None:
    """Syntax and rules: the daemon writes, a subscriber reads and does not command."""
    acl = (ROOT / "systemd/mosquitto/skin.acl").read_text()
    assert "user operator" in acl
    program = programs.require("mosquitto")
    text = (ROOT / "systemd/mosquitto/skin.conf").read_text()
    kept = [
        line for line in text.splitlines() if not line.startswith(("cafile", "certfile", "keyfile"))
    ]
    text = "\n".join(kept).replace("/etc/mosquitto/skin", str(tmp_path / "skin"))
    text = text.replace("/var/lib/mosquitto/", f"{tmp_path}/").replace("listener 8883", "")
    text = "user root\n" + text.replace("listener 1883 127.0.0.1", f"listener 0 {tmp_path}/socket")
    (tmp_path / "skin.passwords").write_text("")
    (tmp_path / "skin.acl").write_text(acl)
    (tmp_path / "mosquitto.conf").write_text(text)
    try:
        done = subprocess.run(
            [program, "-c", tmp_path / "mosquitto.conf"],
            check=False,
            capture_output=True,
            text=True,
            timeout=1.0,
        )
    except subprocess.TimeoutExpired:
        return  # it runs
    pytest.fail(done.stderr)
