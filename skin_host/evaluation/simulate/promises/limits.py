"""How far off, how late, and how much anything may be before a promise is broken."""

import numpy as np
from numpy.typing import NDArray

from skin_host.evaluation.simulate.troubles import LONGEST_STALL_S

NS = 1_000_000_000
LONG_AGO_NS = -(1 << 62)
Mask = NDArray[np.bool_]

#: Truth is sampled this often, and so many samples are looked back on.
SAMPLE_S = 0.25
SAMPLES = 8
#: Sweeps of a board that may be under way, or be cut off, at the two ends of a life.
SLACK = 3
#: What comes of a board is valid for no longer than so many of its periods after its last frame.
STALE_PERIODS = 8
#: A board that zeroes itself has not been received for so many of its periods: only how its pads
#: rest shows it, surely on boards with so many.
UNHEARD_PERIODS = 3
SURE_PADS = 48
#: Pads that press at least so much and read less than that are felt wrong, and the reverse.
PRESSED_KPA, FELT_KPA = 25.0, 2.0
UNTOUCHED_KPA = 25.0
#: Foam keeps less than this part of what pressed it, for seconds after it was lifted.
KEPT = 0.15
#: So many standard deviations of the noise of sums of a pad's readings are no press either: by
#: chance one reading in three million is more, and an hour has ten thousand looks at each pad.
SIGMAS = 5.0
#: A pad is pressed at all; and so long after it began, a touch may not be decided yet.
TOUCHING_KPA = 0.2
DECIDED_NS = NS // 2
#: A press is felt after so many samples, and is not for so many more where a chip has just come
#: back.
FELT_SAMPLES, DEAF_SAMPLES = 6, 3
#: A press that began longer ago must be felt.
PAUSE_NS = round(0.75 * NS)
#: A touch that begins is of something that presses, or did no longer ago.
CAUSE_NS = 3 * NS
#: Touches by noise alone are not more than the odds of the decision give with this probability: a
#: run of the demo's robot may have none in two minutes, and one in an hour.
UNLIKELY = 1e-3
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
