"""The service under a real systemd: started, hung, killed, set otherwise, without what it needs."""

import time
from collections.abc import Callable

import pytest

from tests.support import machine as machines
from tests.support.machine import Done, Machine, now
from tests.support.service import CONFIGURATION, DROP_INS, PIP, UNIT, Service

pytestmark = pytest.mark.timeout(900)


def reports(service: Service, since: str, says: str) -> Callable[[], bool]:
    """Whether the service has reported an error of this text since then."""
    return lambda: says in service.journal(since, "-p err")


def test_an_answer_that_nobody_waited_for_is_not_taken_for_the_next(
    machine: Machine, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch, pytest.raises(AssertionError, match="no answer"):
        patch.setattr(machines, "GRACE_S", -10.0)
        machine.run("sleep 2; echo late", timeout_s=10.0)
    assert machine.do("echo next") == "next"


def test_installing_brings_everything_and_asks_for_nothing_but_a_configuration(
    machine: Machine, installed: Done
) -> None:
    assert installed.status == 0, installed.output
    assert "Next: write /etc/skin-host/main.toml" in installed.output
    machine.do(
        "ls /etc/systemd/system/skin-host@.service /usr/local/bin/skin "
        "/etc/systemd/network/80-skin-can.network /usr/local/share/doc/skin-host/restart.conf"
    )
    assert machine.do("sysctl -n net.core.rmem_max") == "4194304"
    assert machine.do(f"systemd-analyze verify --man=no {UNIT}.service") == ""
    Service(machine).configure()
    machine.do(f"skin check {CONFIGURATION}")


def test_the_unit_exposes_little(machine: Machine, installed: Done) -> None:
    machine.do(f"systemd-analyze security --no-pager --threshold=13 {UNIT}.service")


def test_a_started_service_is_ready_calibrated_and_nobody(service: Service) -> None:
    status = service.machine.do(f"cat /proc/{service.pid}/status")
    assert "CapEff:\t0000000000000000" in status
    assert "Uid:\t0\t" not in status
    # It waits two seconds for a broker, which are few on a slow computer.
    shown = "skin status --json | grep -q left_hand"
    service.machine.until(lambda: service.machine.run(shown).status == 0, "no status")


def test_a_service_that_hangs_is_restarted_and_its_journal_says_where_it_hung(
    service: Service,
) -> None:
    since, before = now(service.machine), service.pid
    service.machine.do(f"kill -STOP {before}")
    service.machine.until(lambda: service.restarted(before), "it is not restarted")
    assert "Watchdog timeout" in service.journal(since)
    assert 'File "/opt/skin-host' in service.journal(since)


def test_a_service_that_is_killed_comes_back_with_its_calibration(service: Service) -> None:
    since, before, known = now(service.machine), service.pid, service.calibration()
    service.machine.do(f"kill -KILL {before}")
    service.machine.until(lambda: service.restarted(before), "it is not restarted")
    service.machine.until(service.works, "it does not work again")
    assert service.calibration() == known
    assert "calibrating for" not in service.journal(since)


def test_a_reload_takes_a_new_threshold_without_a_restart(service: Service) -> None:
    since, before = now(service.machine), service.pid
    service.configure(more="\n[processing.touch]\nmargin_units = 7\n")
    service.machine.do(f"systemctl reload {UNIT}")
    service.machine.until(lambda: "read again" in service.journal(since), "it is not read")
    assert service.active
    assert service.pid == before


def test_a_reload_lasts_until_it_is_done_where_systemd_can_wait_for_it(service: Service) -> None:
    version = int(service.machine.do("systemctl --version").split()[1])
    kind = service.machine.do(f"systemctl show --property=Type --value {UNIT}")
    assert kind == ("notify-reload" if version >= 253 else "notify")


def test_a_reload_that_would_be_refused_fails_and_changes_nothing(service: Service) -> None:
    for wrong, says in (
        ("nonsense = ", "not TOML"),
        ("\n[processing.touch]\nmargin_units = 'seven'\n", "margin_units"),
        (
            "\n[service]\nmetrics_port = 9000\n",
            "service.metrics_port changed; that needs a restart",
        ),
    ):
        since, before = now(service.machine), service.pid
        service.configure(more=wrong)
        assert service.machine.run(f"systemctl reload {UNIT}").status != 0
        service.machine.until(
            reports(service, since, says),
            f"no error in the journal: {says}",
        )
        assert "read again" not in service.journal(since)
        assert service.active
        assert service.pid == before


def test_a_broker_that_is_gone_is_waited_for(service: Service) -> None:
    since, before = now(service.machine), service.pid
    service.machine.do("systemctl stop mosquitto")
    service.machine.until(lambda: "away" in service.status, "it does not notice")
    service.machine.until(
        lambda: "broker" in service.journal(since, "-p warning"), "no warning in the journal"
    )
    service.machine.do("systemctl start mosquitto")
    service.machine.until(service.works, "it does not come back")
    assert service.pid == before


def test_an_adapter_that_is_absent_at_the_start_is_used_once_it_is_there(
    service: Service,
) -> None:
    machine = service.machine
    machine.do(f"systemctl stop {UNIT} robot")
    service.configure(channel="vcan7")
    since = now(machine)
    machine.do(f"systemctl start {UNIT}")
    before = service.pid
    machine.until(
        lambda: "no such network interface" in service.journal(since, "-p warning"),
        "no warning in the journal",
    )
    time.sleep(20.0)  # longer than what the watchdog, or twenty starts, would take
    assert service.active
    assert service.pid == before
    assert service.show("NRestarts") == ["0"]

    machine.do("ip link add vcan7 type vcan && ip link set vcan7 up && systemctl start robot")
    machine.until(service.works, "it is not used")
    machine.do("systemctl stop robot && ip link del vcan7")
    machine.until(lambda: service.status.startswith("0 frames/s"), "frames of nobody")
    machine.do("ip link add vcan7 type vcan && ip link set vcan7 up && systemctl start robot")
    machine.until(service.works, "it is not used again")
    assert service.pid == before
    machine.do(f"systemctl stop {UNIT} robot; ip link del vcan7")


def test_a_wrong_configuration_is_an_error_in_the_journal_and_not_tried_again(
    service: Service,
) -> None:
    machine = service.machine
    machine.do(f"systemctl stop {UNIT}")
    machine.write(CONFIGURATION, "robot = 3\n")
    since = now(machine)
    assert machine.run(f"systemctl start {UNIT}").status != 0
    assert service.state == "failed failed exit-code"
    assert service.show("ExecMainStatus") == ["2"]
    machine.until(lambda: "wanted" in service.journal(since, "-p err"), "no error in the journal")
    machine.do(f"systemctl reset-failed; rm {CONFIGURATION}")
    assert machine.run(f"systemctl start {UNIT}").status != 0
    assert service.state == "failed failed exit-code"


def test_a_password_comes_as_a_credential_and_without_its_file_nothing_is_tried_again(
    service: Service,
) -> None:
    machine = service.machine
    machine.write(
        "/etc/mosquitto/conf.d/lane.conf",
        "listener 1883 127.0.0.1\nallow_anonymous false\npassword_file /etc/mosquitto/passwords\n",
    )
    machine.do(
        "mosquitto_passwd -b -c /etc/mosquitto/passwords skin-host open-sesame && "
        "chown mosquitto /etc/mosquitto/passwords && systemctl restart mosquitto"
    )
    try:
        machine.write("/etc/skin-host/mqtt-password", "open-sesame", mode="600")
        machine.do(
            "install -D -m 644 /usr/local/share/doc/skin-host/skin-host-password.conf "
            f"{DROP_INS}/password.conf && systemctl daemon-reload"
        )
        service.configure(more="")
        text = machine.do(f"cat {CONFIGURATION}")
        machine.write(CONFIGURATION, text.replace("[mqtt]", '[mqtt]\nusername = "skin-host"'))
        machine.do(f"systemctl restart {UNIT}")
        machine.until(service.works, "it may not talk to the broker")
        shown = machine.do(
            f"cat /proc/{service.pid}/environ /proc/{service.pid}/cmdline | tr '\\0' ' '"
        )
        assert "open-sesame" not in shown
        machine.do("rm /etc/skin-host/mqtt-password")
        assert machine.run(f"systemctl restart {UNIT}").status != 0
        assert service.state == "failed failed exit-code"
        assert service.show("ExecMainStatus") == ["243"]
    finally:
        machine.do("rm -f /etc/mosquitto/conf.d/lane.conf; systemctl restart mosquitto")


def test_debians_mosquitto_starts_with_the_example_configuration(
    machine: Machine, installed: Done
) -> None:
    machine.do(
        "mkdir -p /etc/mosquitto/certs && cd /etc/mosquitto/certs && "
        "openssl req -x509 -newkey rsa:2048 -nodes -keyout server.key -out server.crt -days 30 "
        "-subj /CN=lane -addext 'subjectAltName=DNS:localhost' && cp server.crt ca.crt && "
        "mosquitto_passwd -b -c /etc/mosquitto/skin.passwords operator press && "
        "cp /usr/local/share/doc/skin-host/skin.acl /etc/mosquitto/ && "
        "chown mosquitto certs * ../skin.passwords ../skin.acl; "
        "cp /usr/local/share/doc/skin-host/skin.conf /etc/mosquitto/conf.d/"
    )
    try:
        machine.do("systemctl restart mosquitto")
        machine.do(
            "mosquitto_sub -h localhost -p 8883 --cafile /etc/mosquitto/certs/ca.crt "
            "-u operator -P press -t 'skin/#' -E -W 20"
        )
    finally:
        machine.do(
            "rm /etc/mosquitto/conf.d/skin.conf /etc/mosquitto/skin.*; "
            "systemctl reset-failed mosquitto; systemctl restart mosquitto"
        )


def test_it_comes_back_by_itself_after_a_reboot(service: Service) -> None:
    machine = service.machine
    machine.do(f"systemctl enable {UNIT} robot")
    known = service.calibration()
    machine.reboot()
    machine.until(service.works, "it did not come back")
    assert service.calibration() == known
    assert service.show("NRestarts") == ["0"]
    assert "calibrating for" not in machine.do(f"journalctl -b -o cat -u {UNIT}")


def test_an_upgrade_goes_on_with_the_old_version_and_says_what_ends_that(service: Service) -> None:
    machine, before = service.machine, service.pid
    machine.do(
        """sed -i 's/^__version__ = .*/__version__ = "9.9.9"/' skin-host/skin_host/__init__.py"""
    )
    said = machine.do(f"{PIP} make -C skin-host install", 600.0)
    assert "systemctl restart skin-host@main.service" in said
    assert service.active
    assert service.pid == before
    machine.do(f"systemctl restart {UNIT}")
    machine.until(service.works, "the new version does not work")
    version = machine.do("mosquitto_sub -h 127.0.0.1 -t skin/demo/nodes/main/info -C 1 -W 20")
    assert '"9.9.9"' in version


def test_uninstalling_leaves_configuration_and_calibrations_and_nothing_else(
    service: Service,
) -> None:
    machine, known = service.machine, service.calibration()
    machine.write(f"{DROP_INS}/own.conf", "[Service]\nNice=-5\n")
    machine.do(f"systemctl enable {UNIT}")
    machine.do("make -C skin-host uninstall")
    assert not service.active
    left = machine.do(
        r"find / -xdev \( -path /proc -o -path /root -o -path /var/log \) -prune -o "
        "-name '*skin*' -print"
    )
    assert sorted(left.splitlines()) == [
        "/etc/skin-host",
        "/var/lib/private/skin-host",
        "/var/lib/skin-host",
    ]
    assert machine.do("systemctl list-units --all --no-legend 'skin-host*'") == ""
    assert service.calibration() == known
