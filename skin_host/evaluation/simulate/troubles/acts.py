"""Acts of an operator or systemd, which are no troubles, and what health may report of them."""

from skin_host.evaluation.simulate.troubles.codes import (
    CALIBRATED,
    CHIPS,
    SET_UP,
    TIMING,
    TIPS,
    ZEROED,
)
from skin_host.evaluation.simulate.troubles.trouble import Trouble, nothing


def act(name: str) -> Trouble:
    """An act of an operator or systemd, and what health may report for it."""
    return Trouble(name, name, nothing, ACTS[name], lasts_s=(0.0, 0.0))


#: What health may report after these acts, which are not faults.
ACTS: dict[str, set[str]] = {
    # What the broker and the boards do not know yet; a board that just stopped must be queried.
    "start": ZEROED
    | TIPS
    | {"broker_away", "bus_silent", "board_absent", "board_silent", "board_lost_set_up"}
    | {"triangle_missing", "bus_loses_frames"},
    "calibrate": CALIBRATED | {"taxel_pressed"},
    "configure": ZEROED
    | TIPS
    | {"bus_silent", "board_silent", "triangle_missing", "bus_loses_frames"},
    "disable": {"part_disabled"},
    "power": SET_UP | CHIPS | TIMING | {"bus_silent"},
    "enable": set(),
    "thresholds": set(),
    "reload": set(),
}
