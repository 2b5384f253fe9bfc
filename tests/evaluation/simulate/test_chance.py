"""Noise alone may touch a pad as rarely as is promised."""

import pytest

from skin_host.evaluation.simulate.promises.chance import Chance, too_many
from skin_host.evaluation.simulate.promises.limits import MEASUREMENTS_A_FALSE_TOUCH

S = 1_000_000_000
#: Measurements of the demo's robot in an hour.
HOUR = 396 * 20 * 3600


@pytest.mark.parametrize(
    ("touches", "measurements", "wrong"),
    [
        (0, 0, False),
        (1, HOUR // 40, True),
        (1, HOUR, False),
        (2, HOUR, True),
        (60, 2000 * HOUR, False),
    ],
)
def test_touches_by_noise_are_as_rare_as_promised(
    touches: int, measurements: int, wrong: bool
) -> None:
    assert too_many(touches, measurements) == wrong


def test_more_touches_than_measurements_allow_are_too_many() -> None:
    assert too_many(3 * 100, int(100 * MEASUREMENTS_A_FALSE_TOUCH))
    assert not too_many(100, int(100 * MEASUREMENTS_A_FALSE_TOUCH))


def test_one_touch_is_counted_once_and_a_second_one_is_not_explained() -> None:
    chance = Chance()
    assert not chance.explains(7, S)
    chance.measurements = HOUR
    assert chance.explains(7, 100 * S)
    assert chance.explains(7, 101 * S)
    assert chance.touches == 1
    assert chance.lately(102 * S) == [7]
    assert chance.lately(104 * S) == []
    assert not chance.explains(8, 101 * S)
    assert not chance.explains(7, 200 * S)
