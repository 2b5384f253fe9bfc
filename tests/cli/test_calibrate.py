"""A calibration's verdicts, a triangle a line."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from skin_host.cli.calibrate import triangle_table
from skin_host.config.settings import load
from skin_host.layout import build_layout
from skin_host.processing.calibration import Calibration, Verdict, Zero
from skin_host.processing.calibration.outcome import outcome, triangle_verdicts

CONFIG = Path(__file__).parents[2] / "config" / "demo.toml"
LAYOUT = build_layout(load(CONFIG), CONFIG.parent)


def calibration(**bad: list[int]) -> Calibration:
    """All well but for these flat taxels."""
    verdict = np.full(LAYOUT.n_taxels, Verdict.OK, np.uint8)
    for name, taxels in bad.items():
        verdict[taxels] = Verdict[name.upper()]
    zeros = np.zeros(LAYOUT.n_taxels)
    return Calibration("x", "y", "z", *[zeros] * 6, verdict)


def test_triangles_that_are_well_are_one_line_a_board() -> None:
    said = triangle_table(triangle_verdicts(calibration(), LAYOUT, [0, 1]))
    assert said.splitlines() == [
        "part          board          triangles  verdict",
        "left_hand     hand           0-4,8-11   ok",
        "left_forearm  forearm_outer  0-15       ok",
        "left_forearm  forearm_inner  0-7        ok",
    ]


def test_a_triangle_with_bad_taxels_has_its_own_line_and_names_them() -> None:
    bad = calibration(noisy=[13, 14], stuck=[15], absent=list(range(24, 36)))
    found = triangle_verdicts(bad, LAYOUT, [0])
    assert triangle_table(found).splitlines()[1:] == [
        "left_hand  hand   0,3-4,8-11  ok",
        "left_hand  hand   1           2 noisy: 13, 14; 1 stuck: 15",
        "left_hand  hand   2           absent",
    ]
    assert [one["verdict"] for one in found[:4]] == ["ok", "stuck", "absent", "ok"]
    assert found[1]["taxels"] == {"noisy": [13, 14], "stuck": [15]}


@pytest.mark.parametrize("pad", [6, 10])
def test_thermal_pads_have_no_verdict(pad: int) -> None:
    first = LAYOUT.part("left_forearm").start
    (triangle, *_) = triangle_verdicts(calibration(stuck=[first + pad]), LAYOUT, [1])
    assert triangle["pressure_taxels"] == 10
    assert triangle["verdict"] == "ok"


def test_what_was_touched_is_of_the_boards_and_pads_that_were_calibrated() -> None:
    hand, forearm = (LAYOUT.parts[i].start for i in (0, 1))
    unchanged = np.zeros(LAYOUT.n_taxels, np.bool_)
    unchanged[hand + 4] = True
    touched = [hand + 3, hand + 4, forearm + 5]
    found = replace(calibration(touched=touched), unchanged=unchanged)
    every = outcome(found, LAYOUT, [0, 1])
    assert every["touched"] == {"left_hand": [3], "left_forearm": [5]}
    assert every["unchanged"] == {"left_hand": [4]}
    (board,) = LAYOUT.parts[0].boards
    one = outcome(found, LAYOUT, [0, 1], [board])
    assert one["touched"] == {"left_hand": [3]}
    assert {triangle["part"] for triangle in one["triangles"]} == {"left_hand"}


def test_a_fingertip_whose_zero_is_the_one_before_is_unchanged() -> None:
    none = np.zeros(6)
    old, new, pressed = Zero(none, none), Zero(none, none), Zero(none, none, touched=True)
    before = replace(calibration(), zeros={"a": old, "b": old})
    found = replace(before, zeros={"a": old, "b": new, "c": pressed})
    assert outcome(found, LAYOUT, [0], fingertips="abcd", before=before)["fingertips"] == {
        "a": "unchanged",
        "b": "ok",
        "c": "touched",
        "d": "absent",
    }
    assert outcome(found, LAYOUT, [0])["fingertips"] == {}
