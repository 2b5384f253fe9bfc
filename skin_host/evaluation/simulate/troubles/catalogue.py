"""The kinds of trouble that a robot can have, by name."""

from skin_host.bus.port import LinkState
from skin_host.config.settings import Settings
from skin_host.evaluation.simulate.disk import FULL, READ_ONLY
from skin_host.evaluation.simulate.troubles.broker import (
    broker_absent,
    broker_disconnects,
    broker_doubles,
    broker_frozen,
    broker_refuses,
)
from skin_host.evaluation.simulate.troubles.buses import (
    SURE_LOSS,
    address_twice,
    frames,
    interface,
    light_loss,
    other_host,
)
from skin_host.evaluation.simulate.troubles.codes import (
    BUS,
    CALIBRATED,
    CHIPS,
    DAMAGED,
    SET_UP,
    SWAPPED,
    TAXELS,
    TIMING,
)
from skin_host.evaluation.simulate.troubles.computer import (
    disk,
    disk_slow,
    set_clock,
    stall,
    suspended,
)
from skin_host.evaluation.simulate.troubles.hardware import board_latched, emulated, mixed
from skin_host.evaluation.simulate.troubles.trouble import FOR_EVER_S, Begin

_LINE = {"line_shorted", "triangle_no_ack", "triangle_not_connected"}
#: A chip that does not answer may show in one sweep only, which may pass between two looks of
#: health: then its board zeroes itself, and what follows does not show it.
_UNANSWERED = _LINE | {"triangle_silenced"}
_WRONG_BITS = _LINE | {"board_rezeroed", "bus_bit_errors", "taxel_out_of_range"}
_SILENCED = {"triangle_silenced", "triangle_answers_again"}
_WRONG_BITS |= {"triangle_out_of_range", *_SILENCED}
#: A board that zeroes itself meanwhile takes a wrong bit into a pad's zero. If it is the highest,
#: the pad's bytes jump from one end of the scale to the other until the board is zeroed again.
_WRONG_ZERO = frozenset({"taxel_noisy"})
_ELSEWHERE = {"triangle_not_connected", "triangle_out_of_range", "taxel_out_of_range"}
KINDS: dict[str, Begin] = {
    "chip_gone": emulated("chip_gone", CHIPS | SET_UP, {"triangle_not_connected"}, 1.0),
    # It may stay as it was pressed, until repeats are no chance any more.
    "stuck_taxel": emulated(
        "stuck_taxel", {"taxel_stuck", "taxel_unproven"}, {"taxel_stuck"}, 20, spoils=True
    ),
    # With noise of many units it reads far out of range now and then.
    "noisy_taxel": emulated(
        "noisy_taxel",
        {"taxel_noisy", "taxel_unproven", "taxel_out_of_range", "bus_bit_errors", *CALIBRATED},
        {"taxel_noisy"},
        4.0,
        spoils=True,
    ),
    "shorted_finger": emulated("shorted_finger", CHIPS | SET_UP, _UNANSWERED, 1.0),
    # Where two chips drive one data line, their bytes mix, differently in each sweep.
    "wrong_address": mixed("wrong_address", SWAPPED | {"bus_bit_errors"}, _ELSEWHERE),
    "swapped_lines": mixed("swapped_lines", SWAPPED, _ELSEWHERE | _LINE | {"lines_swapped"}),
    "shared_address": mixed("shared_address", SWAPPED | {"bus_bit_errors"}, _ELSEWHERE),
    "no_acknowledge": mixed("no_acknowledge", SWAPPED, _UNANSWERED),
    "data_held_low": emulated(
        "data_held_low",
        CHIPS | SET_UP,
        # In the middle of a reading it turns one pad's bytes into ones and changes nothing besides.
        _LINE | _SILENCED | {"board_in_doubt"},
        1.0,
        spoils=True,
    ),
    "clock_stretched": emulated("clock_stretched", SWAPPED, _ELSEWHERE | _LINE, 1.0, spoils=True),
    # What a wrong bit does to a reading, or to the board that takes it for a missing chip.
    **{
        name: emulated(
            name,
            SWAPPED | {"bus_bit_errors"},
            _WRONG_BITS,
            4.0,
            spoils=True,
            lasting=_WRONG_ZERO,
        )
        for name in ("bit_flipped", "slow_rise")
    },
    "brown_out": emulated(
        "brown_out",
        SWAPPED,
        _ELSEWHERE | _LINE,
        1.0,
        spoils=True,
        recovers_s=FOR_EVER_S,
        lingers=True,
        lasts_s=(0.0, 0.0),
    ),
    "board_reset": emulated(
        "board_reset",
        SET_UP | CHIPS | TIMING | {"bus_silent"},
        {"board_silent", "board_reset", "bus_silent"},
        2.0,
        lasts_s=(0.0, 0.0),
    ),
    "board_silent": emulated(
        "board_silent",
        SET_UP | CHIPS | TIMING | {"bus_silent"},
        {"board_silent", "bus_silent"},
        2.0,
    ),
    "late_period": emulated(
        "late_period",
        TIMING | SET_UP | CHIPS | {"bus_silent"},  # it is set up again, and silent meanwhile
        {"board_period"},
        4.0,
        values=(3.0, 40.0),
    ),
    "jittered_period": emulated(
        "jittered_period",
        TIMING | SET_UP | CHIPS,
        {"board_jitter", "board_period"},
        4.0,
        values=(2.0, 8.0),
        sure=6.0,
    ),
    "frame_loss": emulated(
        "frame_loss", BUS, {"bus_loses_frames"}, values=(0.01, 0.3), sure=SURE_LOSS
    ),
    "bit_errors": emulated(
        "bit_errors",
        BUS | DAMAGED,
        {"bus_bit_errors"},
        values=(0.0005, 0.05),
        sure=0.02,
        spoils=True,
    ),
    "bus_off": emulated("bus_off", BUS, {"bus_silent"}, 2.0),
    "babbling_node": emulated(
        "babbling_node",
        BUS | {"bus_babbling", "bus_drops"},
        {"bus_babbling"},
        2.0,
        values=(0.6, 1.2),  # a third of them leave no gap
        lasts_s=(0.5, 3.0),  # thousands of frames a second cost what minutes of others do
    ),
    "temperature_step": emulated(
        "temperature_step",
        {"part_temperature", "bus_bit_errors"} | TAXELS,
        {"part_temperature"},
        3.0,
        values=(-4.0, 4.0),
        # Where bytes are coarse the next lower one of a temperature pad must still show it.
        sure=3.8,
        spoils=True,
        recovers_s=60.0,
    ),
    "frames_lost": frames("lost", BUS, 0.5, must="bus_loses_frames", sure=SURE_LOSS),
    "frames_late": frames("late", BUS, 0.2),
    "frames_doubled": frames("doubled", BUS, 0.2),
    "frames_swapped": frames("swapped", BUS, 0.5),
    "frames_damaged": frames(
        "damaged", BUS | DAMAGED, 0.05, must="bus_bit_errors", sure=0.02, spoils=True
    ),
    "address_twice": address_twice,
    "adapter_gone": interface("adapter_gone", LinkState.GONE, "bus_gone"),
    "link_down": interface("link_down", LinkState.DOWN, "bus_down"),
    "stall": stall,
    "suspended": suspended,
    "clock_set": set_clock,
    "broker_absent": broker_absent,
    "broker_frozen": broker_frozen,
    "broker_refuses": broker_refuses,
    "broker_disconnects": broker_disconnects,
    "broker_doubles": broker_doubles,
    "disk_full": disk("disk_full", FULL),
    "disk_read_only": disk("disk_read_only", READ_ONLY),
    "disk_slow": disk_slow,
}
#: Storms and drills draw none of these: what lasts for longer than a storm has a time of its own,
#: and another host comes in a rehearsal.
APART: dict[str, Begin] = {"light_loss": light_loss, "other_host": other_host}
#: Those of robots with fingertips alone: what other robots draw does not depend on them.
OF_FINGERTIPS: dict[str, Begin] = {"board_latched": board_latched}


def kinds_of(settings: Settings) -> dict[str, Begin]:
    """Return the kinds of trouble that a robot can have."""
    return KINDS | OF_FINGERTIPS if settings.fingertips else KINDS
