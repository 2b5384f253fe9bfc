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
