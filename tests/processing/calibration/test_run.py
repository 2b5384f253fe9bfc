"""How long a calibration looks: its time, and enough samples however slow the boards are."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from skin_host.bus.wire import FrameBatch, encode_sweep
from skin_host.config.settings import load
from skin_host.layout import build_layout
from skin_host.processing.calibration import Verdict
from skin_host.processing.calibration.calibrator import KNOWN_SAMPLES
from skin_host.processing.calibration.run import SHORTEST_S
from skin_host.processing.core import Engine
from tests.support.stack import ROOT

CONFIG = ROOT / "config" / "demo.toml"


def sweeps_taken(
    engine: Engine,
    time_s: Callable[[int], float],
    shift: Callable[[int], int | NDArray[np.int64]] = lambda _: 0,
    seconds: float = 4.0,
) -> int:
    """How many sweeps a calibration takes, of which number `i` comes at `time_s(i)`.

    Its readings are lower by `shift(i)`, which is called before it is sent.
    """
    hand = engine.layout.boards[0]
    triangles = np.array(hand.triangles)
    rng = np.random.default_rng(1)
    status = np.zeros(len(triangles), np.uint16)
    engine.begin_calibration(seconds)
    sent = 0
    while engine.calibration_progress() < 1.0:
        readings = rng.integers(238, 242, (len(triangles), 12)) - shift(sent)
        values = readings.astype(np.uint8)
        ids, data = encode_sweep(hand.settings.address, triangles, values, status)
        t_ns = round(1e9 * time_s(sent))
        frames = [(int(i), bytes(d), t_ns) for i, d in zip(ids, data, strict=True)]
        engine.feed(hand.settings.bus, FrameBatch.of(frames))
        sent += 1
        assert sent < 400
    return sent


@pytest.fixture
def engine() -> Engine:
    """Of the hand, whose chips have shown that they live."""
    settings = load(CONFIG)
    layout = build_layout(settings, CONFIG.parent)
    made = Engine(settings, layout, [layout.parts.index(layout.part("left_hand"))])
    rng = np.random.default_rng(4)
    for t_ms in (500, 550, 600, 650):
        bus = layout.boards[0].settings.bus
        made.feed(bus, sweep_of(made, 0, rng, t_ms * 1_000_000))
    return made


@pytest.mark.parametrize(("period_s", "sweeps"), [(0.05, 81), (0.2, KNOWN_SAMPLES)])
def test_four_seconds_are_enough_for_quick_boards_only(
    engine: Engine, period_s: float, sweeps: int
) -> None:
    assert sweeps_taken(engine, lambda number: 1.0 + number * period_s) == sweeps


@pytest.mark.parametrize("period_s", [0.01, 0.05])
def test_a_request_for_less_takes_what_noise_is_known_from(engine: Engine, period_s: float) -> None:
    """Half a second shows some pads as half as noisy as they are, and that was believed."""
    taken = sweeps_taken(engine, lambda number: 1.0 + number * period_s, seconds=0.5)
    assert taken >= KNOWN_SAMPLES
    assert (taken - 1) * period_s >= SHORTEST_S


def sweep_of(engine: Engine, board: int, rng: np.random.Generator, t_ns: int) -> FrameBatch:
    """A sweep of a board with noise of 3 units."""
    own = engine.layout.boards[board]
    triangles = np.array(own.triangles)
    values = np.rint(rng.normal(235.0, 3.0, (len(triangles), 12))).astype(np.uint8)
    status = np.zeros(len(triangles), np.uint16)
    ids, data = encode_sweep(own.settings.address, triangles, values, status)
    return FrameBatch.of([(int(i), bytes(d), t_ns) for i, d in zip(ids, data, strict=True)])


def test_a_board_that_is_back_in_the_middle_is_waited_for() -> None:
    """Its part had sent enough with its other board, so that of this one little was used."""
    settings = load(CONFIG)
    layout = build_layout(settings, CONFIG.parent)
    part = layout.parts.index(layout.part("left_forearm"))
    engine = Engine(settings, layout, [part])
    rng = np.random.default_rng(2)
    first, late = layout.parts[part].boards
    engine.begin_calibration(4.0)
    number = 0
    while engine.calibration_progress() < 1.0:
        t_ns = 1_000_000_000 + number * 50_000_000
        for board in (first, late) if number >= 60 else (first,):
            bus = layout.boards[board].settings.bus
            engine.feed(bus, sweep_of(engine, board, rng, t_ns))
        number += 1
        assert number < 200
    assert number >= 60 + KNOWN_SAMPLES
    found = engine.end_calibration("2026-01-01T00:00:00+00:00")
    verdict = found.verdict[engine.layout.taxels_of([late])]
    assert not np.isin(verdict, (Verdict.TOO_FEW, Verdict.ABSENT)).any()


def test_a_board_that_falls_silent_goes_on_with_its_zero(engine: Engine) -> None:
    """Of a noisy pad little is known then; and so it is where the zero was in doubt."""
    rng = np.random.default_rng(3)
    bus = engine.layout.boards[0].settings.bus
    number = 0

    def send(sweeps: int) -> None:
        nonlocal number
        for _ in range(sweeps):
            number += 1
            engine.feed(bus, sweep_of(engine, 0, rng, 1_000_000_000 + number * 50_000_000))

    engine.begin_calibration(5.0)
    send(110)
    first = engine.end_calibration("2026-01-01T00:00:00+00:00")
    engine.use(first)
    mine = engine.layout.taxels_of([0])
    used = mine & first.usable
    assert engine.pipeline is not None
    engine.pipeline.baseline[used] += 1.0
    engine.begin_calibration(5.0)
    send(20)
    found = engine.end_calibration("2026-01-01T00:00:01+00:00")
    assert found.unchanged is not None
    assert (found.unchanged[used] == found.usable[used]).all()
    assert found.unchanged[used].all()
    assert np.abs(found.baseline - first.baseline - 1.0)[used].max() < 0.3
    engine.use(found)
    assert (engine.pipeline.baseline[used] == found.baseline[used]).all()
    engine.zeros.rezero(0)
    engine.begin_calibration(5.0)
    send(15)
    found = engine.end_calibration("2026-01-01T00:00:02+00:00")
    assert found.unchanged is not None
    assert not found.unchanged.any()
    assert (found.verdict[mine] == Verdict.TOO_FEW).all()


@pytest.mark.parametrize("step_s", [3600.0, 1.5, -1.5, -3600.0])
def test_a_clock_that_is_set_shortens_no_calibration(engine: Engine, step_s: float) -> None:
    def time_s(number: int) -> float:
        return 10_000.0 + number * 0.05 + step_s * (number >= 10)

    # One interval more, of which nobody knows how long it was.
    assert sweeps_taken(engine, time_s) == 82
    verdict = engine.end_calibration("2026-01-01T00:00:00+00:00").verdict
    mine = engine.layout.taxels_of([0])
    assert (verdict[mine] != Verdict.TOO_FEW).all()


def test_a_board_that_is_zeroed_during_a_calibration_is_calibrated_with_its_new_zero(
    engine: Engine,
) -> None:
    """Otherwise a press for the first half and a new zero for the second would look the same."""

    def shift(number: int) -> int:
        if number == 35:
            engine.zeros.rezero(0)
        return 20 if number < 35 else 0

    # For all of its time: the zero of a noisy pad is not known from the rest of it.
    assert sweeps_taken(engine, lambda number: 1.0 + 0.05 * number, shift) >= 35 + 80
    found = engine.end_calibration("2026-01-01T00:00:00+00:00")
    mine = engine.layout.taxels_of([0])
    no_load = engine.layout.boards[0].settings.no_load
    assert (found.verdict[mine] == Verdict.OK).all()
    assert np.abs(found.baseline[mine] - (no_load - 239.5)).max() < 1.5


def test_boards_that_are_away_take_nothing_back_however_often_they_are_set_up() -> None:
    settings = load(CONFIG)
    layout = build_layout(settings, CONFIG.parent)
    engine = Engine(settings, layout, list(range(len(layout.parts))))
    away = list(range(1, len(layout.boards)))

    def shift(number: int) -> int:
        if number % 10 == 5:
            for board in away:
                engine.zeros.rezero(board)
        return 0

    assert sweeps_taken(engine, lambda number: 1.0 + 0.05 * number, shift) < 90
    assert engine.calibration_begun_again == 0


def test_of_a_calibration_it_is_known_how_often_one_board_took_it_back(engine: Engine) -> None:
    def shift(number: int) -> int:
        if number in {20, 45}:
            engine.zeros.rezero(0)
        return 0

    assert sweeps_taken(engine, lambda number: 1.0 + 0.05 * number, shift) >= 45 + 80
    assert engine.calibration_begun_again == 2


@pytest.mark.parametrize("first", [True, False])
def test_a_board_that_is_zeroed_while_its_calibration_is_computed_finds_its_zero_anew(
    engine: Engine, first: bool
) -> None:
    if not first:
        sweeps_taken(engine, lambda number: 1.0 + 0.05 * number)
        engine.use(engine.end_calibration("2026-01-01T00:00:00+00:00"))
    sweeps_taken(engine, lambda number: 10.0 + 0.05 * number)
    compute = engine.collected("2026-01-01T00:00:00+00:00")
    engine.zeros.rezero(0)
    engine.use(compute())
    bus = engine.layout.boards[0].settings.bus
    found = engine.feed(bus, sweep_of(engine, 0, np.random.default_rng(5), 20_000_000_000))
    assert engine.intake.veto[0].all()
    assert not any(frame.valid.any() for frame in found.frames)


def test_a_pad_of_which_too_little_was_received_is_as_noisy_as_it_is_in_the_next_calibration(
    engine: Engine,
) -> None:
    """It was held to the limit of a pad without noise: refused as noisy, and so absent again."""
    sweeps_taken(engine, lambda number: 1.0 + 0.05 * number)
    first = engine.end_calibration("2026-01-01T00:00:00+00:00")
    pad = int(engine.layout.boards[0].taxel_index[engine.layout.boards[0].triangles[1], 4])
    verdict, noise = first.verdict.copy(), first.noise.copy()
    verdict[pad], noise[pad] = Verdict.TOO_FEW, 0.0
    engine.use(replace(first, verdict=verdict, noise=noise))
    noisy = np.zeros((len(engine.layout.boards[0].triangles), 12), np.int64)

    def shift(number: int) -> NDArray[np.int64]:
        noisy[1, 4] = 12 * (number % 2)
        return noisy

    sweeps_taken(engine, lambda number: 10.0 + 0.05 * number, shift)
    assert engine.intake.liveness.spikes.sum() == 0
    found = engine.end_calibration("2026-01-01T00:00:00+00:00")
    assert found.verdict[pad] not in {Verdict.ABSENT, Verdict.TOO_FEW}


def test_a_pad_that_was_calibrated_with_too_little_noise_is_calibrated_with_all_of_it(
    engine: Engine,
) -> None:
    """As noisy, it was left out of each calibration, and kept the noise that made it so."""
    sweeps_taken(engine, lambda number: 1.0 + 0.05 * number)
    engine.use(engine.end_calibration("2026-01-01T00:00:00+00:00"))
    board = engine.layout.boards[0]
    pad = int(board.taxel_index[board.triangles[1], 4])
    scattered = np.zeros((len(board.triangles), 12), np.int64)
    rng = np.random.default_rng(2)

    def shift(number: int) -> NDArray[np.int64]:
        scattered[1, 4] = rng.integers(-8, 9)
        return scattered

    sweeps_taken(engine, lambda number: 10.0 + 0.05 * number, shift)
    assert engine.intake.liveness.noisy.any()
    engine.use(engine.end_calibration("2026-01-01T00:00:00+00:00"))
    sweeps_taken(engine, lambda number: 20.0 + 0.05 * number, shift)
    found = engine.end_calibration("2026-01-01T00:00:00+00:00")
    assert not found.unchanged[pad]
    assert found.noise[pad] > 3.0


def test_a_zero_from_before_is_over_with_the_next_calibration(engine: Engine) -> None:
    sweeps_taken(engine, lambda number: 1.0 + 0.05 * number)
    engine.use(engine.end_calibration("2026-01-01T00:00:00+00:00"))
    engine.zeros.rezero(0)
    sweeps_taken(engine, lambda number: 10.0 + 0.05 * number)
    engine.use(engine.end_calibration("2026-01-01T00:00:00+00:00"))
    assert not engine.intake.veto
