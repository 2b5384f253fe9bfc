"""Codes of health in sets: what may be reported because of a kind of trouble."""

TAXELS = {
    "taxel_out_of_range",
    "taxel_noisy",
    "taxel_stuck",
    "taxel_drifting",
    "taxel_at_limit",
    "taxel_held",
    "taxel_refused",
    "taxel_pressed",
    "taxel_returned",
    "taxel_saturates",
    "taxel_unproven",
    "taxel_unreached",
}
TRIANGLES = {
    "triangle_answers_again",
    "triangle_not_connected",
    "triangle_no_ack",
    "triangle_silenced",
    "triangle_frozen",
    "triangle_constant",
    "triangle_missing",
    "triangle_out_of_range",
    "line_shorted",
    "lines_swapped",
}
#: A board that is set up again, and what it may have done to need that.
SET_UP = {
    "board_absent",
    "board_in_doubt",
    "board_lost_set_up",
    "board_reset",
    "board_rezeroed",
    "board_silent",
}
TIMING = {"board_jitter", "board_period", "bus_loses_frames"}
CHIPS = TAXELS | TRIANGLES
#: Verdicts of a calibration that was taken meanwhile.
CALIBRATED = {"taxel_refused", "taxel_saturates", "taxel_drifting", "taxel_at_limit"}
CALIBRATED |= {"taxel_returned", "taxel_unreached"}
DAMAGED = {"bus_bit_errors", "bus_stranger", "bus_babbling"}
DAMAGED |= {"fingertip_saturated", "fingertip_held", "fingertip_noisy", "fingertip_unreached"}
#: A force/torque board that is not received, or not asked yet for its full scales.
TIPS = {"fingertip_absent", "fingertip_silent", "fingertip_not_configured"}
BUS = TIMING | SET_UP | CHIPS | TIPS
BUS |= {"bus_silent", "board_overflows", "fingertip_incomplete", "fingertip_loses_frames"}
SWAPPED = CHIPS | SET_UP | {"part_temperature"}
BROKER = {"broker_away", "touches_dropped", "broker_refuses", "node_name_taken", "broker_rejects"}
BROKER |= {"broker_withholds"}
#: A board that is zeroed: its pads are not valid until its new zero is known.
ZEROED = {"board_rezeroed", "board_in_doubt", "taxel_unproven"}
