"""What is known of a board's zero: pads that were pressed when it was taken, and what looks so."""

from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest

from skin_host.bus.wire import FrameBatch, StatusError, encode_sweep
from skin_host.config.settings import TouchSettings, changed, load
from skin_host.daemon.daemon import Daemon
from skin_host.health import HealthWatch
from skin_host.layout import build_layout
from skin_host.processing.calibration import Verdict
from skin_host.processing.core import Engine, Output, Step
from skin_host.processing.frame import PressureFrame
from skin_host.processing.silent_zero import SWEEPS
from tests.support.stack import ROOT

CONFIG = ROOT / "config" / "demo.toml"
PERIOD_NS = 50_000_000
NO_LOAD = 240
#: Status words mark pads that are far out of range; a byte of 255 is far below zero.
FAR_BELOW = 255


class Hand:
    """An engine with a calibrated board, which sends what it is asked to."""

    def __init__(self, rest_seed: int | None = None, noise_units: int = 1) -> None:
        settings = load(CONFIG)
        layout = build_layout(settings, CONFIG.parent)
        self.engine = Engine(settings, layout, [layout.parts.index(layout.part("left_hand"))])
        self._board = layout.boards[0]
        self._rng = np.random.default_rng(1)
        self._t_ns = 1_000_000_000
        #: Pads are off by up to so much in each reading.
        self._noise_units = noise_units
        #: What each pad rests at, away from its board's zero: the noise of one reading.
        self.rest_units = np.zeros((len(self._board.triangles), 12), np.int64)
        #: What the pads of a second board at its address rest at, which sends 13 ms after each.
        self.other_units: np.ndarray | None = None
        #: The error of the last triangle's chip.
        self.error = 0
        #: How many triangles are lost on their way, from the last on.
        self.lost = 0
        #: Whether the first triangle is lost, too.
        self.first_lost = False
        #: Whether the first frame of the last triangle that comes is lost.
        self.halved = False
        #: Whether the status words mark bytes of 255 as far below zero.
        self.marks_far = True
        #: Takes the outputs.
        self.deliver: Callable[[Output], None] = lambda output: None
        if rest_seed is not None:
            self.rests_elsewhere(rest_seed)
        self.calibrate()

    def calibrate(self, **pads: int) -> None:
        """Calibrate, while the board sends what `send` does."""
        self.engine.begin_calibration(2.0)
        self.send(50, **pads)
        self.engine.use(self.engine.end_calibration("2026-01-01T00:00:00+00:00"))

    def send(self, sweeps: int, **pads: int) -> None:
        """Send sweeps of an untouched board, but for some pads of its first triangle (`p3=255`)."""
        for _ in range(sweeps):
            self._t_ns += PERIOD_NS
            self._send(self._t_ns, self.rest_units, pads)
            if self.other_units is not None:
                self._send(self._t_ns + 13_000_000, self.other_units, {})

    def _send(self, t_ns: int, rest_units: np.ndarray, pads: dict[str, int]) -> None:
        triangles = np.array(self._board.triangles)
        most = self._noise_units
        values = self._rng.integers(NO_LOAD - most, NO_LOAD + most + 1, (len(triangles), 12))
        values -= rest_units
        status = np.zeros(len(triangles), np.uint16)
        status[-1] = self.error
        for name, value in pads.items():
            values[0, int(name[1:])] = value
            if value == FAR_BELOW and self.marks_far:
                status[0] |= 0x10 << int(name[1:])
        ids, data = encode_sweep(
            self._board.settings.address, triangles, values.astype(np.uint8), status
        )
        frames = [(int(i), bytes(d), t_ns) for i, d in zip(ids, data, strict=True)]
        frames = frames[: len(frames) - 2 * self.lost]
        if self.halved:
            del frames[-2]
        if self.first_lost:
            del frames[:2]
        self.deliver(self.engine.feed(self._board.settings.bus, FrameBatch.of(frames)))

    def frames_from_now(self) -> list[PressureFrame]:
        """Return a list to which the frames of all that follows are added."""
        frames: list[PressureFrame] = []
        self.deliver = lambda output: frames.extend(output.frames)
        return frames

    def rest_on_a_new_zero(self) -> None:
        """Send untouched sweeps, be zeroed, and send more until the new zero is in use."""
        self.send(40)
        self.engine.zeros.rezero(0)
        self.send(60)

    def pause(self, seconds: float) -> None:
        """Send nothing, while the bus is read."""
        for _ in range(round(seconds * 1e9 / PERIOD_NS)):
            self._t_ns += PERIOD_NS
            self.deliver(self.engine.expire(self._t_ns))

    def skip(self, sweeps: int) -> None:
        """Send nothing for so many periods, which nobody notices before the next sweep."""
        self._t_ns += sweeps * PERIOD_NS

    def rests_elsewhere(self, seed: int, most: int = 3) -> None:
        """It was zeroed, by one reading, which was off by `most` units at most."""
        rng = np.random.default_rng(seed)
        self.rest_units = rng.integers(-most, most + 1, self.rest_units.shape)

    @property
    def in_doubt(self) -> list[int]:
        return np.flatnonzero(self.engine.zeros.in_doubt(0)[self._board.triangles[0]]).tolist()


@pytest.fixture
def hand() -> Hand:
    return Hand()


def test_a_pad_that_stays_below_zero_was_pressed_when_its_board_was_zeroed(hand: Hand) -> None:
    hand.send(10, p3=FAR_BELOW)
    assert hand.in_doubt == [3]


@pytest.mark.parametrize("sweeps", [1, 2, 4])
def test_a_pad_that_comes_back_at_once_jumps(hand: Hand, sweeps: int) -> None:
    hand.send(sweeps, p3=FAR_BELOW)
    hand.send(1)
    hand.send(10, p4=FAR_BELOW)
    assert hand.in_doubt == []


def test_a_pad_that_a_new_zero_brings_back_does_not_jump(hand: Hand) -> None:
    """Its board is set up just after it has lifted; another pad was pressed then."""
    hand.send(3, p3=FAR_BELOW)
    hand.engine.zeros.rezero(0)
    # What was received last is of the former zero.
    assert hand.in_doubt == [3]
    hand.send(20)
    assert hand.in_doubt == []
    hand.send(1, p4=FAR_BELOW)
    assert hand.in_doubt == [4]


@pytest.mark.parametrize(("below", "doubted"), [(4, []), (5, [3])])
def test_whether_a_pad_stays_below_zero_shows_in_the_sweeps_that_came(
    hand: Hand, below: int, doubted: list[int]
) -> None:
    for _ in range(below):
        hand.first_lost = False
        hand.send(1, p3=FAR_BELOW)
        hand.first_lost = True
        hand.send(2)
    hand.first_lost = False
    hand.send(1)
    assert hand.in_doubt == doubted


def test_pads_that_lift_after_a_zero_under_a_press_show_no_other_chip(hand: Hand) -> None:
    """The others of their triangle were not valid until all were pressed again, and their zeros
    did not follow the temperature meanwhile.
    """
    frames = hand.frames_from_now()
    pressed = {f"p{pad}": 200 for pad in (1, 2, 3, 4, 5)}
    hand.send(40, **pressed)
    hand.engine.zeros.rezero(0)
    hand.send(60)
    hand.send(60, **dict.fromkeys(pressed, FAR_BELOW))
    assert hand.in_doubt == [1, 2, 3, 4, 5]
    assert np.flatnonzero(~frames[-1].valid[:12]).tolist() == [1, 2, 3, 4, 5]


@pytest.mark.parametrize("below", [3, 9])
def test_pads_that_lift_after_a_press_that_nobody_knew_of_show_no_other_chip(
    hand: Hand, below: int
) -> None:
    """The pads that rest where they did are those of the same chip, and stay valid."""
    frames = hand.frames_from_now()
    hand.rest_on_a_new_zero()
    lifted = {f"p{pad}": FAR_BELOW for pad in range(below)}
    hand.send(10, **lifted)
    assert hand.in_doubt == list(range(below))
    hand.send(60, **lifted)
    assert np.flatnonzero(frames[-1].valid[:12]).tolist() == list(range(below, 12))
    # What presses one of them again is in doubt, too.
    hand.send(20, **(lifted | {"p2": 200}))
    assert np.flatnonzero(frames[-1].valid[:12]).tolist() == list(range(below, 12))


@pytest.mark.parametrize(
    "others",
    [
        dict.fromkeys(range(2, 11), 254),
        dict.fromkeys(range(2, 11), 254) | {11: 20},
        {11: 20},
        {11: 0},
    ],
)
def test_pads_far_below_zero_are_of_another_chip_where_others_do_not_rest(
    hand: Hand, others: dict[int, int]
) -> None:
    """Fewer than two rest where they did, or one reads what lifting nothing brings it to."""
    frames = hand.frames_from_now()
    hand.rest_on_a_new_zero()
    hand.send(10, p0=FAR_BELOW, p1=FAR_BELOW, **{f"p{pad}": raw for pad, raw in others.items()})
    assert not frames[-1].valid[:12].any()


def test_a_pad_that_rests_at_the_end_of_its_scale_was_pressed_when_its_board_was_zeroed(
    hand: Hand,
) -> None:
    """Its board marks it only at twice the range; up to there nothing shows where it rests."""
    hand.marks_far = False
    frames = hand.frames_from_now()
    hand.send(95, p3=255)
    assert hand.in_doubt == []
    hand.send(10, p3=255)
    assert hand.in_doubt == [3]
    hand.send(100)
    assert hand.in_doubt == [3]
    assert np.flatnonzero(~frames[-1].valid[:12]).tolist() == [3]


def test_a_pad_whose_readings_are_mostly_cut_off_rests_at_the_end_of_its_scale(hand: Hand) -> None:
    hand.marks_far = False
    for _ in range(30):
        hand.send(19, p3=255)
        hand.send(1, p3=254)
    assert hand.in_doubt == [3]


def test_a_pad_whose_readings_are_cut_off_at_times_rests_inside_its_scale(hand: Hand) -> None:
    hand.marks_far = False
    for _ in range(60):
        hand.send(8, p3=255)
        hand.send(2, p3=254)
    assert hand.in_doubt == []


def test_skin_that_bulges_beside_a_touch_is_not_taken_for_a_lifted_press(hand: Hand) -> None:
    """It reads less for as long as the touch lasts."""
    hand.marks_far = False
    for sweep in range(300):
        hand.send(1, p3=255, p4=NO_LOAD - 60 - sweep % 3)
    assert hand.in_doubt == []
    hand.send(60)
    assert hand.in_doubt == []


def test_a_pad_that_was_refused_is_not_in_doubt_at_the_end_of_its_scale(hand: Hand) -> None:
    hand.marks_far = False
    hand.calibrate(p3=255)
    hand.send(200, p3=255)
    assert hand.in_doubt == []


def test_a_calibration_ends_the_doubt_in_a_pad_that_rested_at_the_end_of_its_scale(
    hand: Hand,
) -> None:
    hand.marks_far = False
    hand.send(150, p3=255)
    assert hand.in_doubt == [3]
    hand.calibrate()
    hand.send(2)
    assert hand.in_doubt == []


def test_a_pad_in_doubt_that_is_pressed_again_and_again_does_not_jump(hand: Hand) -> None:
    """It hovers where the board begins to mark it; another pad that lifts meanwhile is known."""
    hand.send(10, p3=FAR_BELOW)
    hand.send(2, p3=NO_LOAD)
    hand.send(2, p3=FAR_BELOW)
    hand.send(1, p3=NO_LOAD)
    hand.send(10, p4=FAR_BELOW)
    assert hand.in_doubt == [3, 4]


def test_a_part_is_not_off_when_a_pad_shows_that_it_was_pressed_when_zeroed(
    hand: Hand, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not with the next frame already: the other pads of its triangle are valid and untouched."""
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path))
    settings, layout = load(CONFIG), hand.engine.layout
    daemon = Daemon(settings, layout, calibration=hand.engine.calibration)
    hand.engine, hand.deliver = daemon.engine, daemon._deliver
    hand.engine.zeros.release(hand.engine.boards)
    states: list[str] = []
    monkeypatch.setattr(
        daemon.publisher,
        "put_contact",
        lambda part, state: states.append(state) if part == "left_hand" else None,
    )
    hand.send(20)
    assert states[-1] == "OFF"
    hand.send(20, p3=FAR_BELOW)
    assert hand.in_doubt == [3]
    assert states[-1] == "UNKNOWN"
    # As it was pressed when zeroed, it reads zero: nobody knows that it is untouched.
    hand.send(20)
    assert states[-1] == "UNKNOWN"
    daemon.link.close()


def test_a_pad_that_is_pressed_while_its_zero_is_observed_is_in_doubt_until_it_rests(
    hand: Hand,
) -> None:
    valid: list[bool] = []
    hand.deliver = lambda output: valid.extend(bool(frame.valid[3]) for frame in output.frames)
    hand.engine.zeros.rezero(0)
    hand.send(10)
    hand.send(100, p3=NO_LOAD - 12)
    assert hand.in_doubt == [3]
    assert np.flatnonzero(hand.engine.zeros.at_risk(touched=False)).tolist() == [3]
    assert not any(valid)
    hand.send(80)
    assert hand.in_doubt == []
    assert not hand.engine.zeros.may_be_touched().any()
    assert valid[-1]
    hand.send(10, p3=NO_LOAD - 12)
    assert hand.engine.zeros.at_risk(touched=True)[3]


def test_a_pad_that_is_in_doubt_when_its_board_is_zeroed_again_stays_so(hand: Hand) -> None:
    """What pressed it while its zero was observed may be in the next."""
    hand.engine.zeros.rezero(0)
    hand.send(10)
    hand.send(30, p3=NO_LOAD - 12)
    assert hand.engine.zeros.rezero(0) == 1
    hand.send(50)
    assert hand.in_doubt == [3]


@pytest.mark.parametrize(("rests", "pressed"), [(5, 10), (25, 10), (36, 7)])
def test_a_press_that_began_before_its_pad_was_valid_is_in_doubt_after_another_zero(
    hand: Hand, rests: int, pressed: int
) -> None:
    """No touch shows it: while the zero is observed, before it is used, and a sweep after that."""
    hand.engine.zeros.rezero(0)
    hand.send(rests)
    hand.send(pressed, p3=200)
    assert hand.engine.zeros.at_risk(touched=True).sum() == 1
    assert hand.engine.zeros.rezero(0) == 1
    hand.send(60)
    assert hand.in_doubt == [3]


@pytest.mark.parametrize(("rests", "pressed"), [(5, 10), (25, 10), (36, 7)])
@pytest.mark.parametrize("offset", [0, 30])
def test_a_press_that_began_between_the_zeros_of_a_first_set_up_is_in_doubt(
    hand: Hand, rests: int, pressed: int, offset: int
) -> None:
    """Nothing that the board sent before is believed, and with another offset its first zero may be
    far off. The second comes up to seconds later, when other boards have had their first.
    """
    hand.send(10, p5=200)
    hand.engine.zeros.rezero(0, believed=False)
    hand.rest_units[:] = offset
    hand.send(rests)
    hand.send(pressed, p3=200 - offset)
    assert hand.engine.zeros.rezero(0) == 1
    hand.rest_units[:] = 0
    hand.send(60)
    assert hand.in_doubt == [3]


def test_a_press_that_a_board_brings_back_from_a_silence_is_in_doubt_after_a_zero(
    hand: Hand,
) -> None:
    hand.pause(3.0)
    hand.send(SWEEPS, p3=200)
    assert hand.engine.zeros.rezero(0) == 1
    hand.send(60)
    assert hand.in_doubt == [3]


def test_a_press_that_has_lifted_before_its_pad_was_valid_is_in_no_later_zero(hand: Hand) -> None:
    hand.engine.zeros.rezero(0)
    hand.send(25)
    hand.send(5, p3=200)
    hand.send(5)
    assert hand.engine.zeros.rezero(0) == 0


@pytest.mark.parametrize("sweeps", [3, 15, 30, 44])
def test_untouched_pads_are_in_no_doubt_when_their_board_is_zeroed_twice(
    worn: tuple[Hand, list[Step]], sweeps: int
) -> None:
    hand, _ = worn
    for seed in range(20):
        hand.engine.zeros.rezero(0)
        hand.rests_elsewhere(seed)
        hand.send(sweeps)
    assert hand.engine.zeros.rezero(0) == 0


def test_a_triangle_with_pads_below_zero_when_calibrated_is_not_called_constant(hand: Hand) -> None:
    """Its readings are not taken, so it cannot show that it lives; its board's doubt is named."""
    pressed = {"p3": FAR_BELOW, "p4": FAR_BELOW, "p5": FAR_BELOW}
    hand.send(10, **pressed)
    hand.engine.begin_calibration(1.0)
    hand.send(25, **pressed)
    hand.engine.use(hand.engine.end_calibration("2026-01-01T00:00:00+00:00"))
    health = HealthWatch(hand.engine)
    codes: set[str] = set()
    for _ in range(10):
        hand.send(5, **pressed)
        record = health.record(hand.engine.parts[0], hand.engine.ledger.now_ns, {}, {})
        codes |= {fault["code"] for fault in record["faults"]}
    assert "board_in_doubt" in codes
    assert "triangle_constant" not in codes


@pytest.fixture
def worn() -> Iterator[tuple[Hand, list[Step]]]:
    """A calibrated hand whose pads rest away from its zero, and what it delivers."""
    hand = Hand(rest_seed=1)
    steps: list[Step] = []
    hand.deliver = lambda output: steps.extend(output.steps)
    hand.send(20)
    yield hand, steps


def valid_share(step: Step) -> float:
    return float(step.frame.valid.mean())


def expect_new_zeros(hand: Hand, steps: list[Step], times: int = 1) -> None:
    """Its pads rest elsewhere now: none is touched by that, and nearly all are valid in the end."""
    steps.clear()
    hand.send(140)
    assert not any(step.frame.touched.any() for step in steps)
    assert valid_share(steps[-1]) > 0.8
    assert hand.engine.ledger.rezeros.tolist() == [times]


def test_a_touch_that_lasts_through_a_silence_is_felt_again_and_its_zero_in_no_doubt(
    worn: tuple[Hand, list[Step]],
) -> None:
    hand, steps = worn
    hand.send(20, p3=200)
    hand.pause(3.0)
    steps.clear()
    hand.send(2, p3=200)
    assert max(map(valid_share, steps)) == 0.0
    hand.send(SWEEPS + 7, p3=200)
    assert valid_share(steps[-1]) > 0.9
    assert steps[-1].frame.touched.sum() == 1
    assert hand.in_doubt == []
    assert hand.engine.ledger.rezeros.tolist() == [0]


@pytest.mark.parametrize("lost", [5, 20])
def test_lost_sweeps_under_a_touch_leave_three_without_valid_taxels(
    worn: tuple[Hand, list[Step]], lost: int
) -> None:
    """A time-out of four periods, the first sweep after it, and two by which it is known."""
    hand, steps = worn
    hand.send(20, p3=200)
    hand.skip(lost)
    steps.clear()
    hand.send(12, p3=200)
    valid = [valid_share(step) > 0.9 for step in steps if step.frame.computed]
    assert valid.index(True) <= 3
    assert all(valid[3:])
    assert not any(event.event == "end" for step in steps for event in step.events)
    assert hand.in_doubt == []


def test_a_touch_is_in_doubt_though_its_board_counted_as_clear_before_its_zero_showed(
    worn: tuple[Hand, list[Step]],
) -> None:
    """Sweeps from before the zero had waited, and came as if they were new."""
    hand, steps = worn
    hand.send(20, p3=200)
    hand.pause(3.0)
    hand.send(3, p3=200)
    hand.rests_elsewhere(seed=2)
    hand.send(SWEEPS)
    steps.clear()
    hand.send(140)
    assert 3 in hand.in_doubt
    assert not any(step.frame.touched.any() for step in steps)
    assert hand.engine.ledger.rezeros.tolist() == [1]


def test_a_board_that_was_zeroed_unheard_gets_new_baselines(
    worn: tuple[Hand, list[Step]],
) -> None:
    """What was touched before may have been touched then: its zero is in doubt."""
    hand, steps = worn
    hand.send(20, p3=200)
    hand.pause(3.0)
    hand.rests_elsewhere(seed=2)
    expect_new_zeros(hand, steps)
    assert not any(step.events for step in steps)
    assert hand.in_doubt == [3]


@pytest.mark.parametrize("lost", [0, 1])
def test_a_board_that_zeroed_itself_gets_new_baselines_though_what_shows_it_is_lost(
    worn: tuple[Hand, list[Step]], lost: int
) -> None:
    """It does after five readings of a chip that did not answer, and then calls the chip well."""
    hand, steps = worn
    hand.error = StatusError.NO_ACK
    hand.send(5)
    hand.error, hand.lost = 0, lost
    hand.rests_elsewhere(seed=2)
    hand.send(1)
    hand.lost = 0
    expect_new_zeros(hand, steps)


def test_an_mtb3_that_was_zeroed_while_its_status_words_were_lost_gets_new_baselines(
    worn: tuple[Hand, list[Step]],
) -> None:
    """It pauses for four periods, and has not timed out."""
    hand, steps = worn
    hand.engine.ledger.expect_pauses(0)
    hand.skip(3)
    hand.rests_elsewhere(seed=2)
    expect_new_zeros(hand, steps)


def test_an_mtb3_that_only_paused_keeps_its_baselines(worn: tuple[Hand, list[Step]]) -> None:
    hand, steps = worn
    hand.engine.ledger.expect_pauses(0)
    hand.skip(3)
    hand.send(SWEEPS + 1)
    assert valid_share(steps[-1]) > 0.9
    assert hand.engine.ledger.rezeros.tolist() == [0]


def test_a_new_zero_is_not_that_of_two_if_the_board_was_silent_while_it_was_sought(
    worn: tuple[Hand, list[Step]],
) -> None:
    hand, steps = worn
    hand.engine.zeros.rezero(0)
    hand.rests_elsewhere(seed=2)
    hand.send(15)
    hand.pause(3.0)
    hand.rests_elsewhere(seed=3)
    expect_new_zeros(hand, steps)


def test_a_calibration_of_too_few_sweeps_does_not_show_whether_a_board_was_zeroed(
    worn: tuple[Hand, list[Step]],
) -> None:
    hand, _ = worn
    hand.pause(3.0)
    hand.rests_elsewhere(seed=2)
    hand.send(4)
    hand.engine.begin_calibration(0.2)
    hand.send(SWEEPS - 6)
    hand.engine.use(hand.engine.end_calibration("2026-01-01T00:00:00+00:00"))
    hand.send(20)
    assert hand.engine.ledger.rezeros.tolist() == [1]


def test_a_calibration_takes_of_pads_in_doubt_only_what_comes_after_a_silence_is_judged(
    hand: Hand,
) -> None:
    """Their board zeroed itself, which the other pads do not show: they rest where they did."""
    hand.send(10, p3=FAR_BELOW)
    hand.engine.begin_calibration(2.0)
    hand.send(20, p3=252)
    hand.pause(3.0)
    hand.send(3, p3=252)
    hand.send(80)
    found = hand.engine.end_calibration("2026-01-01T00:00:00+00:00")
    board = hand.engine.layout.boards[0]
    taxel = int(board.taxel_index[board.triangles[0], 3])
    assert found.usable[taxel]
    assert found.baseline[taxel] == pytest.approx(0.0, abs=0.5)


@pytest.mark.parametrize("waits", [0, 15, 45])
def test_what_two_boards_send_at_one_address_is_the_zero_of_neither(
    worn: tuple[Hand, list[Step]], waits: int
) -> None:
    """A second board is there when the first is zeroed, or a little later; then it is gone."""
    hand, steps = worn
    other = 4 + np.abs(hand.rest_units)
    hand.other_units = None if waits else other
    hand.engine.zeros.rezero(0)
    hand.rests_elsewhere(seed=2)
    hand.send(waits)
    hand.other_units = other
    hand.send(60)
    assert valid_share(steps[-1]) == 0.0
    hand.other_units = None
    hand.send(20)
    steps.clear()
    hand.send(110)
    assert valid_share(steps[-1]) > 0.8
    assert not any(step.frame.touched.any() for step in steps)
    pipeline = hand.engine.pipeline
    assert pipeline is not None
    triangles = np.array(hand.engine.layout.boards[0].triangles)
    taxels = hand.engine.layout.boards[0].taxel_index[triangles]
    wrong = np.abs(pipeline.baseline[taxels] - hand.rest_units)[taxels >= 0]
    assert np.quantile(wrong, 0.9) < 0.5


def test_a_calibration_takes_nothing_of_two_boards_at_one_address(
    worn: tuple[Hand, list[Step]],
) -> None:
    hand, steps = worn
    hand.other_units = np.abs(hand.rest_units) + 4
    hand.engine.begin_calibration(2.0)
    hand.send(80)
    assert hand.engine.calibration is not None
    known = hand.engine.calibration.usable & hand.engine.layout.taxels_of([0])
    found = hand.engine.end_calibration("2026-01-01T00:00:00+00:00")
    assert found.unchanged is not None
    assert (found.unchanged | ~found.usable).all()
    assert not (found.unchanged & ~known).any()
    assert valid_share(steps[-1]) == 0.0


def test_nothing_is_asked_of_a_board_whose_new_zero_is_known_until_a_pad_is_in_doubt(
    hand: Hand,
) -> None:
    hand.engine.zeros.rezero(0)
    hand.send(20)
    assert not hand.engine.zeros.rezeros[0].over
    assert hand.engine.intake.veto
    hand.send(60)
    assert hand.engine.zeros.rezeros[0].over
    assert not hand.engine.intake.veto
    hand.send(200, p3=255)
    assert hand.in_doubt == [3]
    assert hand.engine.intake.veto[0].sum() == 1


def test_what_touched_pads_read_after_a_silence_shows_no_zero(hand: Hand) -> None:
    """Pressed more weakly than before, they may read as pads do that were just zeroed."""
    hand.rest_units[0] = -3
    hand.engine.zeros.rezero(0)
    hand.send(60)
    found = hand.engine.ledger.rezeros[0]
    pads = [f"p{number}" for number in range(12)]
    hand.send(30, **dict.fromkeys(pads, NO_LOAD - 15))
    assert hand.engine.zeros.at_risk(touched=True).sum() > 6
    hand.pause(1.0)
    hand.send(2 * SWEEPS, **dict.fromkeys(pads, NO_LOAD))
    assert hand.engine.ledger.rezeros[0] == found


def test_taxels_of_a_held_board_show_nothing_until_it_is_released(hand: Hand) -> None:
    frames = hand.frames_from_now()
    zeros, own = hand.engine.zeros, hand.engine.layout.taxels_of([0])
    for held in (False, True, False):
        frames.clear()
        if held:
            zeros.hold([0])
            assert zeros.held is not None
            assert np.array_equal(zeros.held, own)
        else:
            zeros.release([0])
            assert zeros.held is None
        hand.send(20, p3=150, p4=1)
        last = frames[-1]
        assert last.touched[[3, 4]].tolist() == [not held, not held]
        assert (last.pressure_kpa[[3, 4]] > 5.0).tolist() == [not held, not held]
        assert last.beyond_range.any() != held
        assert last.valid.any() != held
        assert last.valid[[3, 4]].tolist() == [not held, not held]
        # What it is in truth is noted for all that: a zero that is taken now has it in it.
        assert zeros.at_risk(touched=True)[:6].tolist() == [False] * 3 + [True] * 2 + [False]
    assert zeros.rezero(0) == 2


def test_only_the_held_board_of_a_part_shows_nothing() -> None:
    settings = load(CONFIG)
    layout = build_layout(settings, CONFIG.parent)
    part = layout.part("left_forearm")
    index = layout.parts.index(part)
    zeros = Engine(settings, layout, [index]).zeros
    n = part.n_taxels
    every = np.ones(n, np.bool_)
    frame = PressureFrame(
        part="left_forearm",
        seq=1,
        t_ns=1,
        raw=np.zeros(n, np.uint8),
        pressure_kpa=np.full(n, 9.0, np.float32),
        touched=every,
        valid=every,
        beyond_range=every,
        computed=True,
    )
    assert zeros.without_held(frame, index) is frame
    first, second = part.boards
    mine = slice(part.start, part.stop)
    zeros.hold([first])
    zeros.hold([second])
    zeros.release([second])
    held = layout.taxels_of([first])[mine]
    shown = zeros.without_held(frame, index)
    for array in (shown.touched, shown.valid, shown.beyond_range, shown.pressure_kpa > 0.0):
        assert np.array_equal(array, ~held)
    assert frame.valid.all()


def test_a_pad_far_below_zero_is_in_doubt_only_while_it_is(hand: Hand) -> None:
    hand.send(1, p3=FAR_BELOW)
    assert hand.in_doubt == [3]
    assert hand.engine.zeros.doubts() == {0: 1}
    hand.send(1)
    assert hand.in_doubt == []
    assert hand.engine.zeros.doubts() == {}


class Noisy(Hand):
    """A board with one noisy pad, which is calibrated with that."""

    def __init__(self) -> None:
        #: Where its pad 7 rests.
        self.rest = NO_LOAD - 10
        self._noise = np.random.default_rng(3)
        super().__init__()

    def send(self, sweeps: int, **pads: int) -> None:
        for _ in range(sweeps):
            super().send(1, p7=int(self.rest + self._noise.integers(-9, 10)), **pads)


def test_a_noisy_pad_may_be_touched_until_its_zero_is_known() -> None:
    """It is observed for longer than the others, which are valid by then."""
    hand = Noisy()
    zeros, send = hand.engine.zeros, hand.send
    zeros.rezero(0)
    send(40)
    assert np.flatnonzero(zeros.may_be_touched()).tolist() == [7]
    # Nobody doubts it: nothing has pressed it.
    assert not zeros.at_risk(touched=False).any()
    assert hand.in_doubt == []
    send(80)
    assert not zeros.may_be_touched().any()


def test_a_zero_that_is_still_sought_when_a_daemon_ends_touches_nothing_at_the_next_start() -> None:
    """What was read of the pad until then is the best that the next one can judge it by."""
    hand = Noisy()
    before = hand.engine
    before.zeros.rezero(0)
    hand.rest -= 12
    hand.send(40)
    assert np.flatnonzero(before.zeros.may_be_touched()).tolist() == [7]
    hand.engine = Engine(before.settings, before.layout, before.parts, before.calibration)
    assert before.pipeline is not None and hand.engine.pipeline is not None
    kept = before.pipeline.baseline
    hand.engine.pipeline.set_zero(np.arange(len(kept), dtype=np.int32), kept)
    hand.engine.zeros.hold([0])
    hand.send(20)
    hand.engine.zeros.rezero(0)
    hand.send(120)
    assert not hand.engine.zeros.pressed().any()
    assert not hand.engine.zeros.at_risk(touched=True).any()


def test_a_press_whose_last_frames_were_lost_before_another_zero_is_in_doubt(hand: Hand) -> None:
    hand.engine.zeros.rezero(0)
    hand.send(5)
    hand.rest_units[-1, 3] = 40
    hand.send(5)
    hand.lost = 1
    hand.send(9)
    assert hand.engine.zeros.rezero(0) == 1


@pytest.mark.parametrize("lost", [0, 1])
def test_what_was_hardly_received_while_nothing_is_valid_presses_nothing(
    hand: Hand, lost: int
) -> None:
    hand.engine.zeros.rezero(0)
    hand.send(2, p3=150)
    assert hand.engine.zeros.rezero(0) == 0
    hand.lost = lost
    hand.send(8)
    assert hand.engine.zeros.rezero(0) == 0


def test_a_board_may_have_zeroed_itself_while_the_triangle_of_a_chip_that_fails_is_missing(
    worn: tuple[Hand, list[Step]],
) -> None:
    """It does so after some more readings, or has already; what is pressed reads untouched then."""
    hand, steps = worn
    hand.send(20, p3=200)
    hand.error = StatusError.NO_ACK
    steps.clear()
    hand.send(3, p3=200)
    assert min(map(valid_share, steps)) > 0.8
    hand.lost = 1
    steps.clear()
    hand.send(2, p3=200)
    # Its fifth reading was the last with the old zero, which nobody received.
    hand.error = 0
    hand.rests_elsewhere(seed=2)
    hand.send(8)
    assert max(map(valid_share, steps)) == 0.0
    hand.lost = 0
    expect_new_zeros(hand, steps)
    assert hand.in_doubt == [3]


def test_a_chip_of_which_only_the_error_comes_is_not_missing(
    worn: tuple[Hand, list[Step]],
) -> None:
    hand, steps = worn
    hand.error, hand.halved = StatusError.NO_ACK, True
    steps.clear()
    hand.send(3)
    assert min(map(valid_share, steps)) > 0.7
    hand.error, hand.halved = 0, False
    hand.rests_elsewhere(seed=2)
    expect_new_zeros(hand, steps)


def test_a_triangle_that_is_missing_for_good_keeps_no_other_from_being_valid(
    worn: tuple[Hand, list[Step]],
) -> None:
    hand, steps = worn
    hand.error = StatusError.NO_ACK
    hand.send(1)
    hand.lost = 1
    expect_new_zeros(hand, steps)
    # It answers again after the new zero was found: there may have been another since.
    hand.error, hand.lost = 0, 0
    hand.send(3)
    assert valid_share(steps[-1]) == 0.0
    expect_new_zeros(hand, steps, 2)


def test_every_taxel_of_a_board_can_be_in_doubt(hand: Hand) -> None:
    doubted = np.zeros(hand.engine.layout.n_taxels, np.bool_)
    doubted[[0, 5]] = True
    hand.engine.zeros.doubt(doubted)
    hand.send(60)
    assert hand.in_doubt == [0, 5]


def test_a_pad_in_doubt_keeps_the_baseline_that_it_had(worn: tuple[Hand, list[Step]]) -> None:
    hand, _ = worn
    pipeline = hand.engine.pipeline
    assert pipeline is not None
    before = pipeline.baseline.copy()
    hand.send(20, p3=150)
    hand.engine.zeros.rezero(0)
    hand.rests_elsewhere(7)
    hand.send(60)
    assert hand.in_doubt == [3]
    assert pipeline.baseline[3] == pytest.approx(before[3], abs=0.3)
    rests = hand.rest_units[0, [0, 1, 2, 4, 5, 6]]
    assert pipeline.baseline[[0, 1, 2, 4, 5, 6]] == pytest.approx(rests, abs=0.8)


def expecting(pad: int) -> tuple["Hand", np.ndarray]:
    """A daemon has started: a pad was touched when the one before was killed."""
    hand = Hand()
    touched = np.zeros(hand.engine.layout.n_taxels, np.bool_)
    touched[hand.engine.layout.boards[0].taxel_index[hand._board.triangles[0], pad]] = True
    hand.engine.zeros.expect_touched(touched)
    return hand, touched


@pytest.mark.parametrize("believed", [False, True])
def test_what_was_touched_before_a_start_is_in_doubt_if_its_board_sends_nothing(
    believed: bool,
) -> None:
    """It was reset: its next zero has in it what presses still."""
    hand, touched = expecting(3)
    hand.engine.ledger.sweeps[0] = 0
    assert (hand.engine.zeros.touched() == touched).all()
    hand.engine.zeros.rezero(0, believed)
    hand.send(60)
    assert hand.in_doubt == [3]
    assert (hand.engine.zeros.pressed() == touched).all()


def test_what_was_touched_before_a_start_is_not_by_what_its_board_sends_since() -> None:
    hand, _ = expecting(3)
    hand.send(20)
    hand.engine.zeros.rezero(0)
    hand.send(60)
    assert hand.in_doubt == []
    assert not hand.engine.zeros.touched().any()


def test_readings_of_a_board_that_was_reset_do_not_show_that_a_touch_is_over() -> None:
    hand, _ = expecting(3)
    hand.send(20)
    hand.engine.zeros.rezero(0, believed=False)
    hand.send(60)
    assert hand.in_doubt == [3]


def verdict_of(hand: Hand, pad: int) -> Verdict:
    calibration = hand.engine.calibration
    assert calibration is not None
    taxel = hand.engine.layout.boards[0].taxel_index[hand._board.triangles[0], pad]
    return Verdict(calibration.verdict[taxel])


def zeroed_while_pressed(below: int = 0) -> Hand:
    """A board was zeroed in a press of its pad 3, which lifts by so many units in the end."""
    hand = Hand()
    hand.send(10, p3=200)
    hand.engine.zeros.rezero(0)
    hand.send(60)
    hand.send(10, p3=NO_LOAD + below)
    assert hand.in_doubt == [3]
    return hand


def test_a_pad_that_is_calibrated_in_the_press_of_its_zero_was_touched() -> None:
    """Its readings cannot show that, so nobody would know that something presses it."""
    hand = zeroed_while_pressed()
    hand.calibrate()
    assert verdict_of(hand, 3) == Verdict.TOUCHED
    assert verdict_of(hand, 4) == Verdict.OK
    # Nothing shows any more that it is pressed, and it need not be.
    hand.calibrate()
    assert verdict_of(hand, 3) == Verdict.OK


@pytest.mark.parametrize("below", [4, 15])
@pytest.mark.parametrize("set_up", [False, True])
def test_a_pad_that_has_lifted_since_its_zero_is_calibrated_at_rest(
    below: int, set_up: bool
) -> None:
    hand = zeroed_while_pressed(below)
    if set_up:
        hand.engine.zeros.rezero(0)
        hand.send(60)
        assert hand.in_doubt == [3]
        below = 0
    hand.calibrate(p3=NO_LOAD + min(below, 14))
    assert verdict_of(hand, 3) == Verdict.OK


def test_a_pad_that_is_pressed_again_when_its_board_is_set_up_is_calibrated_in_that() -> None:
    hand = zeroed_while_pressed(10)
    hand.send(10)  # as far as before
    hand.engine.zeros.rezero(0)
    hand.send(60)
    hand.calibrate()
    assert verdict_of(hand, 3) == Verdict.TOUCHED


def restarted(rests: Callable[[Hand], None], sweeps: int, **pads: int) -> Hand:
    """A daemon has started while a board sends, with the zero that the one before knew or with
    another one; after some sweeps the board is set up, which zeroes it.
    """
    hand = started(rests)
    hand.send(sweeps, **pads)
    hand.engine.zeros.rezero(0)
    hand.rests_elsewhere(seed=3, most=1)
    hand.send(120)
    return hand


def started(rests: Callable[[Hand], None]) -> Hand:
    """A daemon has started, and nothing has been received yet."""
    hand = Hand(rest_seed=1, noise_units=3)
    before = hand.engine
    hand.engine = Engine(before.settings, before.layout, before.parts, before.calibration)
    hand.engine.zeros.hold([0])
    rests(hand)
    return hand


def zeroed_meanwhile(hand: Hand) -> None:
    """No daemon knows that zero: none ran, or the one before was killed before it found it."""
    hand.rests_elsewhere(seed=2)


def keeps_zero(hand: Hand) -> None:
    """Nothing has changed."""


@pytest.mark.parametrize("sweeps", [6, 12, 20])
def test_a_zero_that_no_daemon_knows_touches_nothing_at_a_start(sweeps: int) -> None:
    hand = restarted(zeroed_meanwhile, sweeps)
    assert not hand.engine.zeros.pressed().any()
    assert not hand.engine.zeros.at_risk(touched=True).any()


@pytest.mark.parametrize("rests", [keeps_zero, zeroed_meanwhile])
@pytest.mark.parametrize("sweeps", [12, 20])
def test_what_presses_at_a_start_is_in_doubt_and_known_as_pressed(
    rests: Callable[[Hand], None], sweeps: int
) -> None:
    hand = restarted(rests, sweeps, p3=200)
    assert hand.in_doubt == [3]
    assert np.flatnonzero(hand.engine.zeros.pressed()).tolist() == [3]


def test_a_board_that_is_not_set_up_at_a_start_gets_the_zero_that_it_has() -> None:
    """Its bus takes no commands."""
    hand = started(zeroed_meanwhile)
    hand.send(12)
    hand.engine.zeros.release([0])
    steps: list[Step] = []
    hand.deliver = lambda output: steps.extend(output.steps)
    expect_new_zeros(hand, steps)


#: Eight units press the pad by more than drift or noise, and are less than an operator's margin.
LIGHT = NO_LOAD - 8


def press_lightly(hand: Hand, sweeps: int) -> None:
    """Press its pad 3; what reads the same all the time would be stuck."""
    for sweep in range(sweeps):
        hand.send(1, p3=LIGHT + sweep % 2)


def calibrate_pressed(hand: Hand) -> None:
    hand.engine.begin_calibration(2.0)
    press_lightly(hand, 50)
    hand.engine.use(hand.engine.end_calibration("2026-01-01T00:00:00+00:00"))


def asked_for_firm_presses() -> Hand:
    """An operator wants only firm presses to be touches."""
    hand = Hand()
    before = hand.engine
    touch = msgspec.structs.replace(before.settings.processing.touch, margin_units=20.0)
    settings = changed(before.settings, {"processing.touch": touch})
    hand.engine = Engine(settings, before.layout, before.parts, after=before)
    return hand


def test_a_press_that_is_called_no_touch_is_in_doubt_after_a_zero_under_it() -> None:
    hand = asked_for_firm_presses()
    steps: list[Step] = []
    hand.deliver = lambda output: steps.extend(output.steps)
    press_lightly(hand, 20)
    assert not any(step.frame.touched.any() for step in steps)
    assert hand.engine.zeros.at_risk(touched=True).sum() == 1
    assert hand.engine.zeros.rezero(0) == 1
    hand.send(60, p3=NO_LOAD)
    assert hand.in_doubt == [3]


def test_no_baseline_follows_a_press_that_is_called_no_touch() -> None:
    def reads(hand: Hand) -> float:
        frames = hand.frames_from_now()
        press_lightly(hand, 600)
        return float(np.mean([frame.pressure_kpa[3] for frame in frames[-20:]]))

    assert reads(asked_for_firm_presses()) == pytest.approx(reads(Hand()), rel=0.02)


@pytest.mark.parametrize("make", [Hand, asked_for_firm_presses])
def test_a_pad_that_is_calibrated_in_a_press_that_is_felt_was_touched(
    make: Callable[[], Hand],
) -> None:
    """Its readings alone would not show it: so light a press may be a board's zero."""
    hand = make()
    press_lightly(hand, 20)
    calibrate_pressed(hand)
    assert verdict_of(hand, 3) == Verdict.TOUCHED
    assert verdict_of(hand, 4) == Verdict.OK
    # It reads as if untouched now, and nothing shows that it is not.
    press_lightly(hand, 20)
    calibrate_pressed(hand)
    assert verdict_of(hand, 3) == Verdict.OK


def test_what_is_called_a_touch_is_so_as_soon_as_that_is_asked_for_again() -> None:
    hand = asked_for_firm_presses()
    steps: list[Step] = []
    hand.deliver = lambda output: steps.extend(output.steps)
    press_lightly(hand, 40)
    assert not any(step.frame.touched.any() for step in steps)
    asked = hand.engine
    settings = changed(asked.settings, {"processing.touch": TouchSettings()})
    hand.engine = Engine(settings, asked.layout, asked.parts, after=asked)
    press_lightly(hand, 10)
    assert np.flatnonzero(steps[-1].frame.touched).tolist() == [3]
    assert steps[-1].frame.felt is None
