"""The report for readers: one list of sections, written as Markdown and as HTML, with plots."""

from pathlib import Path

from skin_host.evaluation import tables
from skin_host.evaluation.document import Section
from skin_host.evaluation.document import write as write_document
from skin_host.evaluation.pictures import draw_report
from skin_host.evaluation.tables import Report

PICTURES = "accuracy"


def write(report: Report, folder: Path) -> None:
    """Write report.json, report.html and accuracy.md, and the plots to a folder beside them.

    Raises:
        OSError: the folder cannot be written.
    """
    pictures = {f"{PICTURES}/{name}": picture for name, picture in draw_report(report).items()}
    title = "How accurate, how fast"
    sections = _sections(report)
    write_document(sections, title, report, folder, "report", pictures, markdown_name="accuracy")


def real_skin(document: Report) -> Section:
    """The section on recordings of real skin."""
    if document["absent"] is not None:
        text = (
            f"The recordings are absent: there is no `{document['absent']}`. "
            "`--recordings DIR` names a folder that has them."
        )
        return Section("Real skin", [text], [tables.published(document)])
    return Section(
        "Real skin",
        [
            (
                "Published recordings by others: 280 pads of this technology under known air "
                "pressure, 49 sweeps a second, through the engine that the daemon runs. Each "
                "recording is zeroed on its own first 5 s. Pressure curves and the foam's memory "
                "come from `left_calibration` for all `left_` recordings, and from "
                "`right_calibration` for `right_` ones; nothing is fitted to the others."
            ),
            (
                "`live`: pads that move in the first 5 s and never read below 100 in them; "
                "`usable`: those of them that the calibration keeps and that are valid for at "
                "least half of the recording; others have jumped to another level. `false begins "
                "in 10 s`: "
                "touches that begin while the pressure is constant. `at 60 kPa`: share of usable "
                "pads that are reported as touched within 1 s once the pressure stays that far "
                "over rest. `begins a pad`: how often a usable pad begins to be touched in one "
                "loading and unloading; more than 1 is flicker. `touched 10 s after`: usable pads "
                "that are still touched 10 s after the pressure has come back to within 5 kPa of "
                "rest for good, which is the skin's resolution; empty where the recording ends "
                "before. Errors: RMSE of each usable pad "
                "over the whole recording while it is valid, median and 95th percentile over the "
                "pads; then the RMS of the mean over the pads; the worst pad, which a percentile "
                "hides; and the share of valid readings of usable pads that are off by more than "
                "60 kPa, the press that every pad must detect. `all calibrated`: the same share of "
                "all valid readings of all pads that the calibration keeps, so of those, too, that "
                "are valid for less than half of the recording, and may be wrong whenever they "
                "are. Pressures are paired with sweeps by index, as the data's authors do; beside "
                "that with one lag fitted to the whole file, and with a lag and a rate: by "
                "how much the pressure's clock, which is not recorded, is faster than that of the "
                "sweeps. What the rate takes off is an error of the pairing. Curves that were "
                "fitted with it read no better, because what it shifts in the loading and in the "
                "unloading cancels."
            ),
            *remarks_on_real(document),
            (
                "The second table shows what stands in the way of less: the same pressures, each "
                "time with something known that no calibration knows. A recording is zeroed at "
                "the pressure that is in the chamber then, which nobody knows, and pads of another "
                "day read some percent more or less alike: that is the line of the whole skin. "
                "What all pads read wrong together at a moment, foam's memory and temperature, is "
                "the error in common; what remains without it is the pads' own. The best rising "
                "curve of each pad, fitted to this very recording and its truth, is the limit of "
                "any static curve after this memory."
            ),
            (
                "Choices of the fit were tested within `left_calibration` alone, each piece "
                "read with curves fitted to the others: 5.9 kPa for the median pad where "
                "blocks are left out in turn, 6.8 where the loading is read with curves of "
                "the unloading and the reverse. Curves eight times more or less stiff change "
                "that by 1 to 2 %, equal weights in time by 1 % or less, a robust loss (Huber, "
                "1.5 deviations) by 1 % or less, and a second play does not lower it; without "
                "any it is 9.5 and 14.6. Creep beside the play (one exponential of 10 to 1000 s, "
                "or all of them together) changes it by -1 to +2 %; one of 3 s lowers it by 3 %, "
                "with the wrong sign: it shifts the clock of the pressure by 0.3 s and raises "
                "the error of the mean. Tables that are computed again whenever a zero moves "
                "change the errors below by 0.1 kPa or less. None of these is used. "
                "The pads missed at "
                "40 kPa on `left_steps` are those with 4.5 to 6 units of noise under pressure "
                "in `left_calibration`: from their noise at rest alone 95 instead of 85 % of "
                "the pads would be certain to decide within the second, but such noise would "
                "then be evidence of a touch whenever it returns."
            ),
            "What others reach on these recordings, fitted on `left_calibration` like here"
            + (
                '; then an emulated insole (`foam = "infinergy"`, drawn pads) under the pressure '
                "of `left_calibration`, to which its foam was fitted, beside the recorded one. Its "
                "boards send every 20 ms; the recorded ones every 49 ms, repeated by their host."
                if document["emulated"]
                else ":"
            ),
        ],
        [
            tables.real(document),
            tables.hindsight(document),
            tables.published(document),
            *([tables.emulated(document)] if document["emulated"] else []),
        ],
    )


def remarks_on_real(document: Report) -> list[str]:
    """Return remarks that the table does not show, as sentences."""
    reasons: dict[str, list[str]] = {}
    for row in document["real"]:
        if row["why_no_pressure"]:
            reasons.setdefault(row["why_no_pressure"], []).append(row["recording"])
    lines = [f"No pressures of {', '.join(names)}: {why}." for why, names in reasons.items()]
    grasps = document["grasps"]
    if grasps is not None:
        lines.append(
            f"`{grasps['recording']}`, {grasps['grasps']} grasps of a real iCub hand: "
            f"{grasps['touches']} touches begin, {grasps['early']} of them early."
        )
    return lines


def _sections(report: Report) -> list[Section]:
    machine = report["machine"]
    real = [real_skin(report["real_skin"])] if "real_skin" in report else []
    length = "quick: a quarter of each history, at 5 Hz" if report["quick"] else "the whole"
    return [
        *real,
        Section(
            "What this is",
            [
                (
                    f"Written by `skin report` on {report['date'][:10]} in "
                    f"{report['seconds']:.0f} s ({length}), on {machine['processor']}, "
                    f"{machine['cores']} cores, load {machine['load']}, Python "
                    f"{machine['python']}, numpy {machine['numpy']}. Times depend on the machine "
                    "and on its other load: compare them with the copy of memory timed next "
                    "to them. All following figures are measured on emulated skin with fixed "
                    "seeds: the errors are reproducible."
                ),
                (
                    "Every model was fitted to one record of each truth, a hold of one hour at 65 "
                    "kPa with 75 minutes of rest, and was then tested on the other histories "
                    "without further fits, in the pipeline that the daemon runs, with its window, "
                    "drift and touch decision. F is fractional foam (Cole-Cole) whose losses grow "
                    "with pressure. M softens below its recent highest pressure and recovers in "
                    "half an hour. No model has either mechanism; the headline and the goals refer "
                    "to these two. A is asymmetric (unloading 2.5 times slower, losses that grow "
                    "with pressure, rates with overstress), S has a material clock (times shrink "
                    "with compression), L is linear, H is A with rate-independent plays. None of "
                    "them is the model of a compensator."
                ),
                ("Written by `skin report --output docs` only. Use a quiet machine."),
            ],
        ),
        Section(
            "Goals",
            [
                (
                    "Goals and measured values. What stands in the way where a goal is missed: on "
                    "real skin, the second table above; on foam that differs from the fitted one, "
                    "the columns `perfect model` and `best factor a pad` of the next section."
                ),
            ],
            [tables.goals(report)],
        ),
        Section(
            "What to expect of the pressures",
            [
                (
                    "kPa RMS over nine steps, multistep, grasps and cycling. `fitted`: the foam "
                    "that the model was fitted to. `temperature`: the same foam, 2.8 times faster, "
                    "as some 10 degrees make it. `spread`: pads whose losses differ by 20 % "
                    "(log-normal), and then also with different curves, with the fit of the "
                    "typical foam and without measured gains. `not fitted`: the default parameters "
                    "of the configuration, on foams that finally lose 28, 15 and 40 % of a "
                    "pressure. `default` compares the pressures of the pipeline for exact readings "
                    "with the truth, `with noise` those that it reports from bytes with 0.4 units "
                    "of noise. `perfect model` subtracts the true relaxation of the typical foam: "
                    "the remaining error is that of the reading, and in `spread` one that only a "
                    "measurement of each pad can remove. Without a fit the error is the difference "
                    "of two losses, and no model can know a loss that it was not fitted to. `best "
                    "factor a pad` multiplies the default's relaxation by one number for each pad, "
                    "chosen with all four histories and the truth known: the remaining error is "
                    "caused by the shape of the model."
                ),
                (
                    "After a release a pad reads its own relaxation, so it was tried to learn from "
                    "those readings one rate for the part and one factor for each pad (the laws "
                    "alone, F and M, rests known). With all releases known beforehand that would "
                    "suffice: other rates fall from 1.05 and 1.03 to 0.28 and 0.24 kPa, spread "
                    "losses from 1.94 and 2.86 to 0.26 and 0.29, 15 % of loss without a fit from "
                    "3.43 and 3.73 to 0.55 and 0.60, 40 % from 5.07 and 3.87 to 1.79 and 1.35. "
                    "With the releases until now, 0.3 kPa of noise, zeros wrong by 0.2 kPa and "
                    "fitted, too, it is 0.56 and 1.00, 1.52 and 2.13, 2.58 and 2.89, 3.99 and "
                    "3.00, and fitted foam loses from 0.20 and 0.23 to 0.29: most of a history is "
                    "over before its foam has come back. That reaches no goal that is missed, and "
                    "the baselines follow the same readings. With the factor alone, foam that is "
                    "faster comes back sooner and reads like foam that loses less, while it loses "
                    "more (1.37 and 1.35 for other rates, all releases known). So the model learns "
                    "nothing in use. A fit to one's own skin, at its working temperature, is what "
                    "helps."
                ),
            ],
            [tables.scenarios(report)],
        ),
        Section(
            "Speed against error",
            [
                (
                    "kPa RMS over nine steps, multistep, grasps and cycling on F and M, exact "
                    "readings, in each case of the section above. Cost: ns per taxel-step at 1920 "
                    "taxels, of the model alone; states that are updated once a second cost a 50th "
                    "of a step, because the pipeline computes means anyway. A star marks the "
                    "Pareto front of fitted foam."
                ),
            ],
            [tables.summary(report)],
            f"{PICTURES}/pareto.png",
        ),
        Section(
            "Whose family",
            [
                (
                    "Errors for each truth, on the fitted foam, with the mechanisms that model and "
                    "truth have in common. `its law`: the truth is a limit of the model's own law, "
                    "except for the number of modes; L is one for all models. `a cause`: the model "
                    "has one of the truth's causes of slow unloading, possibly in another form. "
                    "`nothing`: it has none of them."
                ),
            ],
            [tables.family(report)],
        ),
        Section(
            "Errors in full",
            [
                "kPa RMS, exact readings. `perfect` subtracts the true relaxation.",
            ],
            [tables.errors(report, 0.0, measure="rms_kpa")],
            f"{PICTURES}/errors.png",
        ),
        Section(
            "Errors of real readings",
            [
                (
                    "kPa RMS with 0.4 units of noise, whole units and a baseline between two "
                    "codes. The error of `perfect` is the limit of the 8-bit reading. In "
                    "`multistep` a grip is eased to 4 kPa for five minutes: that is below the "
                    "threshold of touch, the baseline follows it, and most of what the default "
                    "adds there is this. Noise decides which pads end their touch then, so the "
                    "second table repeats the default with other draws of it."
                ),
            ],
            [tables.errors(report, 0.4, measure="rms_kpa"), tables.noise_draws(report)],
        ),
        Section(
            "Worst errors and rest",
            [
                (
                    "kPa, exact readings. With states at 1 Hz the worst error is that of the "
                    "first second of a press. First table: worst; second: RMS while nothing "
                    "presses."
                ),
            ],
            [
                tables.errors(report, 0.0, measure="worst_kpa"),
                tables.errors(report, 0.0, measure="rest_rms_kpa"),
            ],
        ),
        Section(
            "Bounded or not",
            [
                (
                    "Error at the end of a press (kPa, not clamped at zero) after this many cycles "
                    "of 5 s at 50 kPa and 5 s without pressure, for the models' laws alone at "
                    "every step, and the relaxation of the truth itself."
                ),
                (
                    "The error of the published model grows without limit; the others follow the "
                    "truth to a cycle that repeats. Changes after cycle 100, which is 1000 s, are "
                    "those of the truth: its slowest modes take 6000 s, and a hold of one hour "
                    "shows them only in part. The default's error is a share of that relaxation: "
                    "losses that grow with pressure cannot be seen at one level, and a fit takes "
                    "the effect of plays on a hold for slow modes."
                ),
            ],
            [tables.cycles(report), tables.cycle_evidence(report)],
            f"{PICTURES}/cycles.png",
        ),
        Section(
            "What models cost",
            ["ns per taxel-step alone, at 50 Hz, and bytes of state per taxel (float64)."],
            [tables.speed(report)],
        ),
        Section(
            "Cost follows need",
            [
                (
                    "The whole pipeline from bytes to kPa, touch and drift, ns per taxel-step, and "
                    "in copies of as many float32 in memory. "
                    "Where the pressures of a part are not subscribed and nothing touches it, most "
                    f"sweeps are only compared with a limit: of {report['unwatched']['sweeps']} "
                    "sweeps with a touch half of the time "
                    f"{report['unwatched']['skipped_sweeps']} were skipped, "
                    f"{report['unwatched']['touches_that_differ']} touch decisions differed, and "
                    f"pressures by {report['unwatched']['worst_difference_kpa']:.2f} kPa at most. "
                    "Second table: pads with equation (1) and the default model; pads with "
                    "equation (1), a filter of noise and the foam's plays in each sweep; and the "
                    "same with own curves. The third against the second is the cost of the curves."
                ),
            ],
            [tables.pipeline(report), tables.own_curves(report)],
            f"{PICTURES}/touched.png",
        ),
        Section(
            "False touches",
            [
                (
                    "Touches begun per hour and taxel of untouched skin, after a calibration of "
                    "5 s. First with noise as it was measured on real skin (one pad in twenty "
                    "disturbed, a share common to each triangle, conversions of 36.9 ms that are "
                    "sent again), two votes of three; then with white noise at 25 Hz, against its "
                    "standard deviation (units) and votes."
                ),
            ],
            [tables.measured_noise(report), tables.false_touches(report)],
            f"{PICTURES}/false_touches.png",
        ),
        Section(
            "Detection",
            ["A sudden press of this many units, 0.4 units of noise, two votes of three."],
            [tables.detection(report)],
        ),
        Section(
            "Drift",
            ["Lag of the baselines behind a steady drift of all taxels, 0.4 units of noise."],
            [tables.drift(report)],
            f"{PICTURES}/drift.png",
        ),
        Section(
            "Long holds",
            [
                (
                    "A press at 65 kPa while everything drifts: is it reported as long as it "
                    "lasts, how wrong is its pressure at the end, and for how long is a touch "
                    "reported after its end. `all`: the whole part is pressed, and no untouched "
                    "taxel shows the drift."
                ),
            ],
            [tables.holds(report)],
        ),
        Section(
            "Localisation",
            ["One probe on the 12-pad triangle (pitch 5 mm), 57 units, 0.4 units of noise; mm."],
            [tables.localization(report)],
        ),
        Section(
            "Force",
            [
                (
                    "`force_n` of the contacts over the load on the emulator's probe: a flat round "
                    "probe at 40 kPa on 2 mm of foam, half a second after it was set down, 0.4 "
                    "units of noise, default parameters; drawn foam that the relaxation was not "
                    "fitted to. A press that comes to no contact counts as 0. `triangle`: the "
                    "probe's middle is anywhere on a triangle that has neighbours on all sides; "
                    "`seam`: it is on the line between two triangles; `inside the edge`: the "
                    "probe touches the edge of the skin from inside; `half over the edge`: its "
                    "middle is on that edge."
                ),
                (
                    "A pad stands for the part of its triangle's outline that is nearest to it. "
                    "These parts add up to the skin, so the mean over all places is right for "
                    "probes of any size. A single press of a probe below some 15 mm, which covers "
                    "only a few pads, reads more on a pad and less between pads, one of 4 mm "
                    "from nothing to twice its force. Lines such as a seam or an edge lie "
                    "in the same way to all pads, so there the mean of a size is not right: a "
                    "probe of 10 mm reads up to a fifth too much or too little. One that "
                    "hangs over the edge of the skin presses where no pad is, and only the load on "
                    "the skin can be reported. The few percent too much that wide probes have "
                    "in common are the error of the pressures. Fingertips and palms were not "
                    "measured."
                ),
            ],
            [tables.force(report)],
        ),
        Section(
            "Parameters found",
            ["Result of each fit to the calibration hold, and what it could not distinguish."],
            [tables.fits(report)],
        ),
    ]
