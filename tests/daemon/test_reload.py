"""A configuration that is read again takes effect whole, or is refused by the key that differs."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from skin_host.cli import main
from skin_host.clock import SteppedClock
from skin_host.config.settings import Bus, changed, load, load_running, needs_restart
from skin_host.errors import RequestError
from skin_host.layout import build_layout
from skin_host.mqtt.messages import ContactState
from tests.support.branch import branch
from tests.support.fault_bench import FaultBench
from tests.support.live import FINGER_N, living
from tests.support.stepped import stepped

CONFIG = Path(__file__).parents[2] / "config"
EXCHANGEABLE = {"covered", "foam_mm", "frames", "localization", "probe_mm"}


def leaves(table: Any, where: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Every value of a configuration with its keys."""
    known = table if isinstance(table, dict) else msgspec.structs.asdict(table)
    for key, value in known.items():
        if isinstance(value, dict | msgspec.Struct):
            yield from leaves(value, (*where, key))
        else:
            yield (*where, key), value


def other(value: Any) -> Any:
    """Something else, whatever it was."""
    match value:
        case bool():
            return not value
        case int() | float():
            return value + 1
        case str():
            return value + "x"
        case list() | tuple():
            return type(value)(() if value else ("x",))
        case _:
            return "x"


@pytest.mark.parametrize("name", ["demo", "fingertips"])
def test_every_key_is_taken_over_or_refused_by_its_name(name: str) -> None:
    settings = load(CONFIG / f"{name}.toml")
    assert needs_restart(settings, load(CONFIG / f"{name}.toml")) is None
    checked = 0
    for keys, value in leaves(settings):
        if keys[0] == "kinds":
            continue
        taken = keys[0] == "processing" or (keys[0] == "parts" and keys[2] in EXCHANGEABLE)
        path = ".".join(keys)
        found = needs_restart(settings, changed(settings, {path: other(value)}))
        assert (found is None) == taken, path
        assert found is None or path.startswith(found)
        checked += 1
    assert checked > 40


def test_the_order_of_boards_and_parts_is_part_of_the_configuration() -> None:
    settings = load(CONFIG / "demo.toml")
    turned = dict(reversed(settings.parts.items()))
    assert needs_restart(settings, changed(settings, {"parts": turned})) == "parts"
    assert needs_restart(settings, changed(settings, {"parts": {}})) is not None


def test_places_of_triangles_may_change_and_triangles_may_not() -> None:
    settings = load(CONFIG / "demo.toml")
    patch, *rest = settings.parts["left_hand"].patches
    moved = changed(patch, {"places": [], "positions": "elsewhere.txt"})
    turned = changed(patch, {"shift": patch.shift + 1})
    key = "parts.left_hand.patches"
    assert needs_restart(settings, changed(settings, {key: [moved, *rest]})) is None
    assert needs_restart(settings, changed(settings, {key: [turned, *rest]})) == key


def test_settings_cannot_be_changed_in_place() -> None:
    settings = load(CONFIG / "demo.toml")
    for table in (settings, settings.mqtt, settings.processing.touch, settings.parts["left_hand"]):
        with pytest.raises(AttributeError):
            setattr(table, msgspec.structs.fields(table)[0].name, None)
    with pytest.raises(KeyError):
        changed(settings, {"mqtt.prot": 1})


def test_a_new_core_goes_on_where_the_old_one_stood(bench: FaultBench) -> None:
    before, told = bench.engine, set(bench.told)
    assert before.pipeline is not None
    before.pipeline.baseline[:20] += 1.5
    baseline = before.pipeline.baseline.copy()
    known = before.ledger, before.calibration, before.intake.liveness
    sweeps = before.ledger.sweeps.copy()
    bench.reload({"processing.touch.margin_units": 3.0, "processing.touch.move_hz": 5.0})
    after = bench.engine
    assert after is not before and after.pipeline is not None
    np.testing.assert_array_equal(after.pipeline.baseline, baseline)
    assert (after.ledger, after.calibration, after.intake.liveness) == known
    bench.run(0.5)
    assert (after.ledger.sweeps - sweeps >= 9).all()
    assert set(bench.told) <= told
    assert all(valid.any() for valid in bench.valid.values())


def test_contacts_keep_their_numbers_over_a_reload(bench: FaultBench) -> None:
    tracker = bench.engine._trackers[0]
    tracker._next_id = 41
    bench.reload({"processing.touch.move_hz": 5.0})
    assert bench.engine._trackers[0]._next_id == 41


def test_thicker_foam_and_other_codes_take_effect_at_once(bench: FaultBench) -> None:
    def pressed_kpa() -> np.ndarray:
        """What the hand feels where every byte is five units below its zero."""
        pipeline = branch(bench.engine.pipeline)
        assert pipeline is not None
        part = bench.layout.parts[0]
        mine = slice(part.start, part.stop)
        raw = np.rint(bench.layout.no_load[mine] - pipeline.baseline[mine] - 5).astype(np.uint8)
        pressure = pipeline.step(0, raw, np.ones(raw.size, bool), bench.now_ns).pressure_kpa
        return pressure[pressure > 0.0]

    before_kpa = pressed_kpa()
    bench.reload({"parts.left_hand.foam_mm": 6.0})
    foam_kpa = pressed_kpa()
    bench.reload({"processing.pressure.code_ff": 0.72})
    codes_kpa = pressed_kpa()
    # The curve bends down: with so few units it is nearly a line.
    assert np.median(foam_kpa / before_kpa) == pytest.approx(3.0, rel=0.1)
    assert np.median(codes_kpa / foam_kpa) == pytest.approx(2.0, rel=0.1)


@pytest.mark.parametrize("name", ["demo", "fingertips", "icub"])
def test_check_says_whether_a_running_daemon_could_take_it(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config, running = CONFIG / f"{name}.toml", tmp_path / "configuration.json"
    check = ["check", str(config), "--running", str(running)]
    settings = load(config)
    taken = changed(settings, {"processing.touch.margin_units": 7.0})
    running.write_bytes(msgspec.json.encode(taken))
    assert main(check) == 0
    assert capsys.readouterr() == ("", "")
    running.write_bytes(msgspec.json.encode(changed(settings, {"mqtt.port": 1884})))
    assert main(check) == 2
    assert "mqtt.port changed; that needs a restart" in capsys.readouterr().err
    assert main(["check", str(tmp_path / "absent.toml"), "--running", str(running)]) == 2


@pytest.mark.parametrize("content", [b"", b"[]", b'{"mqtt": 3}', b"\xff"])
def test_what_a_daemon_runs_with_is_one_line_if_it_is_absent_or_damaged(
    tmp_path: Path, content: bytes
) -> None:
    path = tmp_path / "configuration.json"
    with pytest.raises(RequestError, match="a daemon that runs under systemd writes it"):
        load_running(path)
    path.write_bytes(content)
    with pytest.raises(RequestError, match="damaged"):
        load_running(path)


@stepped
async def test_a_press_lasts_over_another_scale_of_pressure_and_back(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path
) -> None:
    """What foam had lost in kPa of before was more than all of the press: it was published as
    released, and its part as `OFF`.
    """
    async with living(can_bus_settings, tmp_path, clock=clock) as live:
        await live.until_well()
        daemon = live.daemon
        configured = daemon._configured
        put, states = daemon.publisher.put_contact, set[str]()

        def note(part: str, state: ContactState) -> None:
            states.update({state} if part == "left_hand" else ())
            put(part, state)

        live.finger().press(FINGER_N)
        await clock.sleep(20.0)
        daemon.publisher.put_contact = note  # type: ignore[method-assign]
        for foam_mm in (20.0, configured.processing.pressure.foam_mm):
            other = changed(configured, {"processing.pressure.foam_mm": foam_mm})
            daemon._swap(other, build_layout(other, CONFIG))
            await clock.sleep(20.0)
        assert states == {"ON"}
