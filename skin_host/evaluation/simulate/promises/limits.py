"""How far off, how late, and how much anything may be before a promise is broken."""

import numpy as np
from numpy.typing import NDArray

from skin_host.evaluation.simulate.troubles.computer import LONGEST_STALL_S

NS = 1_000_000_000
LONG_AGO_NS = -(1 << 62)
Mask = NDArray[np.bool_]

#: Truth is sampled this often.
SAMPLE_S = 0.25
#: Sweeps of a board that may be under way, or be cut off, at the two ends of a life.
SLACK = 3
#: What comes of a board is valid for no longer than so many of its periods after its last frame.
STALE_PERIODS = 8
#: A board that zeroes itself has not been received for so many of its periods: only how its pads
#: rest shows it, surely on boards with so many.
UNHEARD_PERIODS = 3
SURE_PADS = 48
#: A valid reading is of what pressed so long ago at most: the sweep, the filter of noise (0.5 s)
#: and half a second for which a taxel that was not received stays as it was.
LOOKED_BACK_NS = 5 * NS // 4
#: It is off by no more than this share. The pads' foam is drawn with a stiffness that varies by
#: 12 % (sd), which three times over is 15 % of 60 kPa; memory that the model was not fitted to
#: takes 15 % more. And by no more than this: docs/accuracy.md measures 5.3 kPa RMS on foam that is
#: not fitted.
ERROR_SHARE, ERROR_KPA = 0.3, 6.0
#: So many standard deviations of the noise of a pad's single readings are no error either.
SIGMAS = 5.0
#: Foam keeps less than this part of what pressed it, for seconds after it was lifted.
KEPT = 0.15
#: Equation (1) was measured up to 130 kPa, where the stiffness of pads differs most: a reading of
#: more than this is only known to be of no less.
CALIBRATED_KPA = 100.0
#: A press is a touch from the configured margin on (units), and half a unit each for the untouched
#: byte's scatter, rounding and drift; on a noisy pad from so many standard deviations more on: the
#: mean of the 20 measurements of a second has 1.3 where noise alone reaches it once in 10^9 times,
#: and the evidence has to get that far, too.
DECIDES_UNITS, DECIDES_DEVIATIONS = 1.5, 2.0
#: What is felt on top of what a press of the last minute left is so much more, of that press.
LEFT_SHARE = 0.1
#: A contact stands for its pads' own area at least, and for no more than so many times the pads'
#: even share of their unit's outline: one pad of an iCub's palm is nearest to 2.6 of them. Its
#: normal is no further from those of its pads.
LEAST_AREA, MOST_AREA, MOST_TILT = 0.9, 3.0, np.deg2rad(10.0)
#: A contact of less (its peak) may stay where it was last felt: its place is noise.
FAINT_KPA = 2.0
#: By fewer pads a probe cannot be located in the plane.
LOCATED_PADS = 3
#: What a template has located is no further off than so many of its own standard errors.
LOCATED_SIGMAS = 3.0
#: Numbers of events are rounded.
PUBLISHED = 1e-3
#: Pads that press at least so much are pressed firmly.
PRESSED_KPA = 25.0
#: A pad is pressed at all; and so long after it began, a touch may not be decided yet.
TOUCHING_KPA = 0.2
DECIDED_NS = NS // 2
#: A press is felt after so long, and is not for so many samples more where a chip has just come
#: back.
FELT_NS, DEAF_SAMPLES = 3 * NS // 2, 3
#: A press that began longer ago must be felt.
PAUSE_NS = round(0.75 * NS)
#: A touch that begins is of something that presses, or did no longer ago.
CAUSE_NS = 3 * NS
#: Noise alone touches a pad once in so many measurements: in 10^4 hours of one pad at 25 Hz, so a
#: hand of a hundred pads has one false touch in a hundred hours, which docs/simulate.md promises.
#: More touches than that gives with this probability are a broken promise: a run of the demo's
#: robot may have none in two minutes, and one in an hour.
MEASUREMENTS_A_FALSE_TOUCH, UNLIKELY = 1e9, 1e-3
#: Foam that was pressed still relaxes for so long.
RELAXED_NS = 60 * NS
#: A touch that lasted through a silence begins again within this time.
AGAIN_NS = 3 * NS // 2
#: A touch that lasts is reported within this time of frames that feel it, of which a pause counts
#: for no more than so much.
LASTS_NS, LASTS_PAUSE_NS = 3 * NS // 2, NS // 4
#: A calibration at rest began no longer ago when it is noted.
RESTING_NS = 8 * NS
#: A fingertip is loaded from a small force on, and must be felt from a larger one on.
LOADED_N, FELT_N = 0.05, 1.0
#: What events report of its load is of samples that were taken no longer ago: half a second for
#: which they may wait, and the filter. That has two poles: of a change it passes on up to a tenth
#: more.
LOADED_BACK_NS, OVERSHOOT = 3 * NS // 4, 0.1
#: Where a load presses is judged while it changes by no more than this. The line of its force may
#: meet the surface at a slant, which takes what it is off twice as far at most.
STEADY_SHARE, SLANTED = 0.1, 2.0
#: What has slid so far over a fingertip is reported to slip within this time; and what slips was
#: pulled no longer ago, a stall included.
SLID_MM, SLID_NS, PULLED_NS = 1.0, NS // 4, 5 * NS
#: A board that is set up has so many tasks, and all else no more than this.
TASKS_OF_BOARD = 2
MOST_TASKS = 60
#: Topics of events that are numbered.
EVENTS = {"touch", "slip", "over"}
#: So many objects may live more than after the first calm: histories that are bounded.
MORE_OBJECTS = 60_000
#: A sweep reaches the end of the core within so many of its periods, and this.
FRESH_PERIODS, FRESH_NS = 3, 80_000_000
#: So long after a frame was damaged on a bus, what passed is not compared with what was sent. It
#: waits for no longer than this before it is read.
WRONG_NS, WAITED_NS = 2 * NS, round(LONGEST_STALL_S * NS)
#: What is retained is at the broker so long after it changed, or a connection began.
RETAINED_NS = 2 * NS
#: The broker keeps no `OFF` of a part without a valid taxel for longer.
UNKNOWN_NS = NS
