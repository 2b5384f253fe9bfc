"""Time stamps of other clocks are brought to this computer's."""

import pytest

from skin_host.bus.stamps import Stamps


def test_a_clock_that_is_an_hour_off_is_the_same_clock_in_each_frame():
    """So far stamps are believed: frames seemed to be of now and of an hour ago in turns."""
    stamps = Stamps()
    times_s = [1_700_000_000.0 + 0.025 * number for number in range(400)]
    for number, t_s in enumerate(times_s):
        stamps.note_empty(t_s)
        late_s = 3600.0 + 0.008 * (number % 3 - 1) if number > 200 else 0.004
        found = stamps.here(t_s - late_s, t_s)
        if 220 < number < 270:
            assert found is None
        elif number > 300:
            assert found == pytest.approx(t_s, abs=0.02)


@pytest.mark.parametrize("back_s", [6.0, 65.536, 600.0])
def test_no_frame_is_of_the_past_where_an_adapters_clock_begins_again(back_s: float) -> None:
    """For up to two seconds frames seemed to have waited for as long as it had run. Their sweeps
    were cut, and all periods of that time were missed.
    """
    stamps = Stamps()
    for number in range(400):
        t_s = 1_700_000_000.0 + 0.025 * number
        stamp_s = t_s - 0.004 - (back_s if number >= 200 else 0.0)
        found = stamps.here(stamp_s, t_s)
        stamps.note_empty(t_s)
        if number < 200 or number > 300:
            assert found == pytest.approx(t_s, abs=0.005)
        else:
            assert found is None or found == pytest.approx(t_s, abs=0.005)


def test_frames_that_waited_while_this_computer_was_busy_keep_their_time() -> None:
    """However long that was: the queue was not empty meanwhile."""
    stamps = Stamps()
    for number in range(200):
        t_s = 1_700_000_000.0 + 0.025 * number
        stamps.here(t_s, t_s)
        stamps.note_empty(t_s)
    read_s = t_s + 60.0
    for number in range(1, 100):
        assert stamps.here(t_s + 0.5 * number, read_s) == pytest.approx(
            t_s + 0.5 * number, abs=0.005
        )
