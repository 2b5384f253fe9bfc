"""Pads that their board marks as far out of range: which are pressed there, which are broken."""

from functools import cache
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from skin_host.bus.assembler import Sweep
from skin_host.bus.wire import status_word
from skin_host.cli.common import load_skin
from skin_host.layout import Layout
from skin_host.processing import far_presses
from skin_host.processing.far_presses import ALONE_NS, RELEASED_NS, FarPresses
from skin_host.processing.masks import Mask

BOARD = 1
PERIOD_NS = 50_000_000
#: Long waits are not sampled more often.
SELDOM_NS = 8 * PERIOD_NS
REST, HALF, LIGHT = 240, 100, 230
TRIANGLE = 3
ALL = (1 << 16) - 1


@cache
def skin() -> Layout:
    return load_skin(Path(__file__).parents[2] / "config/demo.toml")[1]


@cache
def near() -> list[list[int]]:
    """Of each pad of the triangle, the pads of the triangle that are beside it."""
    layout = skin()
    taxels = layout.boards[BOARD].taxel_index[TRIANGLE].tolist()
    found = []
    for taxel in taxels:
        begin, end = layout.neighbour_start[taxel : taxel + 2]
        others = layout.neighbour[begin:end].tolist()
        found.append([taxels.index(other) for other in others if other in taxels])
    return found


class Skin:
    """One triangle of a board that is pressed, sweep by sweep."""

    def __init__(self) -> None:
        self.finds = FarPresses(skin(), [BOARD])
        self.now_ns = 0
        self.period_ns = PERIOD_NS
        self.raw = np.full(12, REST, np.uint8)
        self.far: Mask = np.zeros(12, np.bool_)
        self.touched: Mask = np.zeros(12, np.bool_)

    def put(self, pads: dict[int, int | None]) -> None:
        """Pads have these bytes now, None where they are far beyond the end of the scale."""
        for pad, byte in pads.items():
            self.raw[pad] = 0 if byte is None else byte
            self.far[pad] = byte is None

    def step(
        self,
        sweeps: int = 1,
        came: int = ALL,
        error: int = 0,
        veto: Mask | None = None,
        trusted: bool = True,
    ) -> list[int]:
        """Send what the pads have; return those that are found pressed far, after the last."""
        for _ in range(sweeps):
            self.now_ns += self.period_ns
            raw = np.full((16, 12), REST, np.uint8)
            far, touched = (np.zeros((16, 12), np.bool_) for _ in range(2))
            errors = np.zeros(16, np.uint8)
            if came >> TRIANGLE & 1:
                raw[TRIANGLE], far[TRIANGLE], errors[TRIANGLE] = self.raw, self.far, error
            else:
                raw[TRIANGLE] = 0
            touched[TRIANGLE] = self.touched
            sweep = Sweep(BOARD, raw, status_word(far, errors), came, self.now_ns, 0)
            found = self.finds.step(
                0, sweep, far, np.full((16, 12), trusted), veto, touched, self.now_ns
            )
            self.finds.note(0, sweep, touched, self.now_ns)
            assert not found[np.arange(16) != TRIANGLE].any()
            assert not (found & ~self.finds.pressed(0)).any()
            # What is found pressed is touched, and nothing else that is far is.
            self.touched = (self.touched & ~self.far) | found[TRIANGLE]
        return np.flatnonzero(found[TRIANGLE]).tolist()

    def press(self, *pads: int) -> None:
        """Press pads by half and more of their scale."""
        for byte in (HALF, HALF // 2, 0):
            self.put(dict.fromkeys(pads, byte))
            self.step()
            self.touched[list(pads)] = True
        self.step()

    def wait(self, seconds: float) -> list[int]:
        sweeps = round(seconds * 1e9) // PERIOD_NS
        seldom = max(sweeps - 8, 0) // 8
        self.period_ns = SELDOM_NS
        found = self.step(seldom) if seldom else []
        self.period_ns = PERIOD_NS
        return self.step(sweeps - 8 * seldom) if sweeps - 8 * seldom else found


@pytest.fixture
def one() -> Skin:
    """A triangle at rest, that has been received."""
    found = Skin()
    found.step(5)
    return found


PAD = 0


def beside() -> int:
    return near()[PAD][0]


def apart() -> int:
    return next(pad for pad in range(12) if pad != PAD and pad not in near()[PAD])


def test_a_press_that_has_grown_to_the_end_of_the_scale_grows_beyond_it(one: Skin) -> None:
    one.press(PAD)
    one.put({PAD: None})
    assert one.step() == [PAD]
    assert one.wait(300.0) == [PAD]
    one.put({PAD: 0})
    assert one.step() == []
    one.put({PAD: None})
    assert one.step() == [PAD]


def test_a_narrow_press_lasts_for_minutes_and_not_for_ever(one: Skin) -> None:
    one.press(PAD)
    one.put({PAD: None})
    assert one.wait(ALONE_NS * 1e-9) == [PAD]
    assert one.wait(1.0) == []
    # What is touched beside it from now on is no proof.
    one.touched[near()[PAD]] = True
    one.put(dict.fromkeys(near()[PAD], HALF))
    assert one.wait(60.0) == []


@pytest.mark.parametrize("byte", [REST, 255, 200])
def test_a_pad_that_goes_far_where_nothing_presses_is_broken(one: Skin, byte: int) -> None:
    one.put({PAD: byte})
    one.step(3)
    one.put({PAD: None})
    assert one.wait(2.0) == []
    one.put({beside(): HALF})
    one.touched[beside()] = True
    assert one.wait(60.0) == []
    # Once it is in its range, what follows counts.
    one.put({PAD: REST})
    one.step()
    one.put({PAD: None})
    assert one.wait(0.5) == [PAD]


def test_a_pad_that_was_far_from_the_first_sweep_on_is_not_pressed() -> None:
    first = Skin()
    first.put({PAD: None, beside(): HALF})
    first.touched[beside()] = True
    assert first.wait(60.0) == []


def test_a_press_between_two_sweeps_is_one_where_pads_around_it_are_touched_soon(
    one: Skin,
) -> None:
    one.put({PAD: None, beside(): HALF, apart(): HALF})
    assert one.step(3) == []
    one.touched[apart()] = True
    assert one.step(2) == []
    one.touched[beside()] = True
    assert one.step() == [PAD]
    assert one.wait(1000.0) == [PAD]
    one.put({beside(): REST})
    one.touched[beside()] = False
    assert one.wait(RELEASED_NS * 1e-9) == [PAD]
    assert one.step(2) == []


@pytest.mark.parametrize("touched", [False, True])
def test_a_press_of_two_sweeps_is_one(one: Skin, touched: bool) -> None:
    """In the last of which it was touched, or not yet."""
    one.put({PAD: HALF})
    one.step()
    one.touched[PAD] = touched
    one.put({PAD: None})
    assert one.step() == [PAD] * touched
    assert one.step(2) == [PAD]
    assert one.wait(RELEASED_NS * 1e-9 - 0.2) == [PAD]
    assert one.wait(1.0) == [PAD] * touched


def test_a_pad_that_was_lightly_touched_is_believed_for_seconds(one: Skin) -> None:
    one.put({PAD: LIGHT})
    one.touched[PAD] = True
    one.step(5)
    one.put({PAD: None})
    assert one.step() == []
    assert one.wait(0.3) == [PAD]
    assert one.wait(RELEASED_NS * 1e-9) == []


@pytest.mark.parametrize(
    ("byte", "seconds"), [(HALF, RELEASED_NS * 1e-9), (LIGHT, ALONE_NS * 1e-9)]
)
def test_a_pad_that_broke_in_a_press_is_none_when_that_is_over(
    one: Skin, byte: int, seconds: float
) -> None:
    """Pads around it that were pressed firmly show that. A light touch may end in a hold, too."""
    one.press(PAD)
    one.put({PAD: None, beside(): byte})
    one.touched[beside()] = True
    assert one.wait(100.0) == [PAD]
    one.put({beside(): REST})
    one.touched[beside()] = False
    assert one.wait(seconds - 0.1) == [PAD]
    assert one.wait(0.2) == []


def test_a_triangle_whose_pads_are_all_pressed_far_is(one: Skin) -> None:
    pads = list(range(12))
    one.press(*pads)
    for pad in pads:
        one.put({pad: None})
        assert one.step() == pads[: pad + 1]
    assert one.wait(60.0) == pads


def test_one_that_was_pressed_between_two_sweeps_stays_so_beside_one_that_grew(one: Skin) -> None:
    one.press(PAD)
    one.put({PAD: None, beside(): None})
    one.wait(0.5)
    assert one.wait(60.0) == sorted([PAD, beside()])


@pytest.mark.parametrize("pressed", [[], [0, 1], [0, 1, 2, 3, 4]])
def test_pads_that_all_go_far_at_once_are_those_of_a_dead_chip(
    one: Skin, pressed: list[int]
) -> None:
    if pressed:
        one.press(*pressed)
    one.put(dict.fromkeys(range(12), None))
    assert one.wait(5.0) == []


def test_a_chip_that_dies_ends_what_was_pressed_far_on_it(one: Skin) -> None:
    one.press(PAD)
    one.put({PAD: None})
    assert one.step() == [PAD]
    one.put(dict.fromkeys(range(12), None))
    assert one.wait(5.0) == []


def test_frames_that_are_lost_change_nothing(one: Skin) -> None:
    lost = ALL & ~(1 << TRIANGLE)
    one.press(PAD)
    touched = one.touched.copy()
    one.touched[:] = False
    assert one.step(2, came=lost) == []
    one.put({PAD: None})
    assert one.step() == [PAD]
    for _ in range(20):
        one.step(2, came=lost)
        one.touched = touched
        assert one.step() == [PAD]


@pytest.mark.parametrize("when", ["before", "during"])
def test_after_a_gap_nothing_is_known_of_a_far_pad(one: Skin, when: str) -> None:
    one.press(PAD)
    if when == "during":
        one.put({PAD: None})
        assert one.step() == [PAD]
    one.step(11, came=ALL & ~(1 << TRIANGLE))
    one.touched[:] = False
    one.put({PAD: None})
    assert one.wait(2.0) == []


def test_a_pad_of_a_chip_that_had_an_error_is_not_pressed(one: Skin) -> None:
    one.press(PAD)
    one.put({PAD: None})
    assert one.step() == [PAD]
    assert one.step(error=1) == []
    assert one.wait(2.0) == []


def test_a_pad_whose_zero_is_not_known_is_not_pressed(one: Skin) -> None:
    veto = np.zeros((16, 12), np.bool_)
    veto[TRIANGLE, PAD] = True
    one.press(PAD, beside())
    one.put({PAD: None, beside(): None})
    assert one.step() == sorted([PAD, beside()])
    assert one.step(veto=veto) == [beside()]
    assert one.wait(2.0) == [beside()]


@pytest.mark.parametrize("byte", [REST, LIGHT])
def test_a_damaged_frame_is_no_press(one: Skin, byte: int) -> None:
    one.put({PAD: byte, beside(): HALF})
    one.touched[[PAD, beside()]] = byte != REST, True
    one.step(5)
    touched = one.touched.copy()
    for _ in range(5):
        one.put({PAD: None})
        assert one.step() == []
        one.put({PAD: byte})
        one.touched = touched.copy()
        assert one.step() == []


def test_a_byte_inside_the_scale_with_a_mark_is_no_press_and_ends_none(one: Skin) -> None:
    one.press(PAD)
    one.put({PAD: None})
    assert one.step() == [PAD]
    one.raw[PAD] = 77
    assert one.step() == []
    one.raw[PAD] = 0
    assert one.step() == [PAD]
    one.raw[PAD] = 255
    assert one.step() == []
    one.raw[PAD] = 0
    assert one.wait(2.0) == []


def test_a_doubt_hides_a_press_and_does_not_end_it(one: Skin) -> None:
    one.press(PAD)
    one.put({PAD: None})
    assert one.step() == [PAD]
    assert one.step(trusted=False) == [PAD]  # the doubt is the caller's
    assert one.step() == [PAD]


def test_what_is_forgotten_is_not_known() -> None:
    one = Skin()
    one.step(5)
    one.press(PAD)
    one.finds.forget(0)
    one.put({PAD: None})
    assert one.wait(1.0) == []
    assert one.finds.watches(0)
    one.put({PAD: 0})
    one.step()
    assert not one.finds.watches(0)


Course = NDArray[np.uint8]


@given(
    course=st.lists(
        st.lists(st.sampled_from([REST, 255, 200, 130, None]), min_size=12, max_size=12),
        min_size=1,
        max_size=40,
    ),
    lost=st.lists(st.booleans(), min_size=40, max_size=40),
)
@settings(max_examples=80, deadline=None)
def test_however_pads_go_far_none_of_them_is_pressed_where_nothing_was_touched(
    course: list[list[int | None]], lost: list[bool]
) -> None:
    one = Skin()
    one.step(5)
    for bytes_, is_lost in zip(course, lost, strict=False):
        one.put(dict(enumerate(bytes_)))
        assert one.step(came=ALL & ~(is_lost << TRIANGLE)) == []
    assert one.wait(1.0) == []


@given(
    course=st.lists(
        st.lists(
            st.tuples(st.sampled_from([REST, 200, HALF, 10, 0, None]), st.booleans()),
            min_size=12,
            max_size=12,
        ),
        min_size=1,
        max_size=30,
    ),
    lost=st.lists(st.booleans(), min_size=30, max_size=30),
)
@settings(max_examples=25, deadline=None)
def test_however_a_press_went_nothing_is_pressed_for_ever_after_it(
    course: list[list[tuple[int | None, bool]]], lost: list[bool]
) -> None:
    """What stays far when all else is released."""
    one = Skin()
    one.step(5)
    for pads, is_lost in zip(course, lost, strict=False):
        one.put({pad: byte for pad, (byte, _) in enumerate(pads)})
        one.touched = np.array([touched for _, touched in pads])
        one.step(came=ALL & ~(is_lost << TRIANGLE))
    one.put({pad: REST for pad in range(12) if not one.far[pad]})
    one.touched &= one.far
    with patch.object(far_presses, "ALONE_NS", 20_000_000_000):
        # What was pressed less goes on for some seconds after what was pressed more.
        one.wait(20.0 + RELEASED_NS * 1e-9)
        assert one.wait(1.0) == []
