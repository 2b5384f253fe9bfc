"""A robot whose pads are as those of real skin: noisy, some jumping, some dead."""

from pathlib import Path

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from emulator.chips.noise import SENT_UNIT_FF
from emulator.probes.pads import Jumps
from emulator.probes.scene import Place, Probe, Scene
from emulator.robot import Robot
from skin_host.bus.wire import find_skin_frames
from skin_host.cli.common import load_skin
from skin_host.config.settings import Settings
from skin_host.demo import configuration
from skin_host.evaluation.rig import wired
from skin_host.layout import TAXELS_PER_TRIANGLE, build_layout

BOARDS, TRIANGLES = 4, 16
#: The ten pads of a triangle that are not thermal.
PADS = [0, 1, 2, 3, 4, 5, 7, 8, 9, 11]


def robot(scene: Scene, fidelity: str = "signal", skin_type: int = 0) -> Robot:
    """A robot of triangles of ten pads at shift 2, as insoles have them."""
    wiring = wired(BOARDS)
    for board in wiring["boards"].values():
        board["skin_type"] = skin_type
    patches = [
        {"board": name, "triangles": f"0-{TRIANGLES - 1}", "kind": "triangle_10pad"}
        for name in wiring["boards"]
    ]
    document = {"robot": "real", **wiring, "parts": {"skin": {"patches": patches}}}
    settings = msgspec.convert(document, Settings)
    return Robot(settings, build_layout(settings, Path()), scene, fidelity=fidelity)


def pads(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Those of all taxels [..., n] that are not thermal."""
    return values.reshape(*values.shape[:-1], -1, 12)[..., PADS].reshape(*values.shape[:-1], -1)


def received(of: Robot, seconds: float) -> NDArray[np.float64]:
    """The bytes [sweeps, n] that a robot of `robot_of` sends, sweeps of 50 ms."""
    of.bring_up()
    of.step(1.0)
    batch = of.step(seconds)["can0"]
    found = find_skin_frames(batch)
    values = np.full((round(seconds / 0.05), BOARDS, TRIANGLES, 14), np.nan)
    sweep = np.clip(((batch.t_ns - batch.t_ns[0]) / 5e7).astype(int), 0, len(values) - 1)
    for row, triangle, half in zip(found.row, found.triangle, found.half, strict=True):
        board = (int(batch.id[row]) >> 4 & 0xF) - 1
        values[sweep[row], board, triangle, 7 * half : 7 * half + 7] = batch.data[row, 1:]
    return values[..., :TAXELS_PER_TRIANGLE].reshape(len(values), -1)


@pytest.fixture(params=["signal", "chip"])
def fidelity(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def test_pads_are_as_noisy_as_recorded_ones(fidelity: str) -> None:
    """Standard deviations of `left_calibration` at rest, as sent at shift 2."""
    values = received(robot(Scene(quiet=False), fidelity=fidelity), 5.0)
    deviation = pads(np.nanstd(values, axis=0))
    live = deviation > 0

    assert np.percentile(deviation[live], [5, 25, 50, 75]) == pytest.approx(
        [0.69, 0.82, 1.04, 1.41], rel=0.12
    )
    assert np.percentile(deviation[live], 95) == pytest.approx(5.3, rel=0.2)


def test_fingertips_are_as_noisy_in_their_own_finer_units_as_recorded_ones() -> None:
    """Not four times as noisy, which brought some pads to the end of their scale."""
    settings, layout = load_skin(configuration("icub.toml"))
    tips = [unit.kind.startswith("fingertip") for unit in layout.triangles]
    skin = Robot(settings, layout, Scene(quiet=False)).skin
    units = (skin.noise_ff / layout.unit_ff).reshape(-1, TAXELS_PER_TRIANGLE)[tips]
    assert layout.unit_ff.reshape(-1, TAXELS_PER_TRIANGLE)[tips].max() < SENT_UNIT_FF
    assert units.min() > 0.2
    assert units.max() < 1.8


def test_both_fidelities_send_the_same_noise() -> None:
    robots = [robot(Scene(quiet=False), fidelity=kind) for kind in ("chip", "signal")]
    robots[0].converters.by_bus = True
    chip, signal = (received(one, 1.0) for one in robots)

    np.testing.assert_array_equal(chip, signal)


def test_a_dead_pad_sends_the_same_byte_for_ever(fidelity: str) -> None:
    plain = robot(Scene(quiet=False, seed=2), fidelity, skin_type=2)
    dead = ~np.isnan(plain.skin.held_ff)
    values = received(plain, 2.0)

    assert dead.any()
    np.testing.assert_array_equal(np.nanstd(values, axis=0) == 0, dead)


def test_a_quiet_scene_has_neither_dead_nor_jumping_pads() -> None:
    good = robot(Scene(quiet=True))
    deviation = np.nanstd(received(good, 5.0), axis=0)

    assert np.isnan(good.skin.held_ff).all()
    assert np.percentile(deviation, 95) < 1.1


def test_a_pad_jumps_above_its_pressure_and_back_well_below() -> None:
    jumps = Jumps(np.array([50.0, np.inf]), np.array([30.0, 30.0]))
    pads = np.array([0, 1])

    course = [jumps.step_ff(pads, np.full(2, kpa))[0] for kpa in (40, 60, 40, 31, 29, 40)]

    assert course == [0, 30, 30, 30, 0, 0]
    assert jumps.step_ff(pads, np.full(2, 300.0))[1] == 0


def test_a_temperature_pad_does_not_jump() -> None:
    """Nothing presses it; a board with compensation would take its jump off all other pads."""
    thermal = np.tile(np.isin(np.arange(12), (6, 10)), (300, 1))
    jumps = Jumps.drawn(thermal, np.random.default_rng(1))

    assert jumps.can.any()
    assert not jumps.can[thermal.ravel()].any()


def test_a_pressed_pad_that_jumps_moves_by_tens_of_units() -> None:
    def deepest(*, quiet: bool) -> NDArray[np.float64]:
        everywhere = [
            Probe(
                part="skin",
                at=Place(taxel=taxel),
                diameter_mm=3.0,
                pressure_kpa=[(0.0, 0.0), (0.5, 150.0), (1.0, 0.0)],
            )
            for taxel in range(3, BOARDS * TRIANGLES * 12, TAXELS_PER_TRIANGLE)
        ]
        pressed = robot(Scene(quiet=quiet, seed=3, probe=everywhere))
        pressed.step(0.5)
        return np.asarray((pressed.skin.capacitance_ff - pressed.skin.resting_ff)[3::12])

    more_units = (deepest(quiet=False) - deepest(quiet=True)) / SENT_UNIT_FF
    jumped = more_units > 10

    assert 0 < np.count_nonzero(jumped) < 0.2 * len(jumped)
    assert np.all((more_units[jumped] >= 15) & (more_units[jumped] <= 40))
    assert np.all(more_units[~jumped] == 0)
