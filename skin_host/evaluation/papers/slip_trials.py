"""How soon a slip is found, and how often one is cried for nothing."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from emulator.probes.held_objects import Friction, HeldObjects
from skin_host.evaluation.papers.grasp_loops import FORCE_HZ, NOISE_N
from skin_host.fingertip.slip import RatioDrop, ShearRate, friction_used

Floats = NDArray[np.float64]

#: Thresholds under test: rate of the shear force, and safe share of known friction.
SHEAR_RATE_N_S = 6.0
SAFE_SHARE = 0.8

DETECTORS = ("shear rate", "ratio drop", "known friction")


@dataclass(frozen=True, slots=True)
class SlipTrials:
    """Slid way, and time since the object began to move, when each detector spoke.

    One row a detector of `DETECTORS`, one column a trial; infinite where it stayed silent,
    negative times where it spoke before.
    """

    slipped_mm: Floats
    delay_s: Floats


class _Detectors:
    """The three detectors over n contacts; `step` gives bool[3, n]."""

    def __init__(self, n: int, friction: float) -> None:
        self._rate = ShearRate(n, FORCE_HZ)
        self._drop = RatioDrop(n, force_sd_n=NOISE_N)
        self._friction = friction

    def step(self, normal_n: Floats, shear_n: Floats) -> NDArray[np.bool_]:
        return np.stack(
            [
                self._rate.step(shear_n) > SHEAR_RATE_N_S,
                self._drop.step(normal_n, shear_n),
                friction_used(normal_n, shear_n, self._friction) > SAFE_SHARE,
            ]
        )


def slip_trials(
    rng: np.random.Generator,
    n: int = 200,
    *,
    noise_n: float = NOISE_N,
    sliding_share: float = 0.85,
) -> SlipTrials:
    """Let n objects slip under a rising load, with various grips and rates.

    Static friction is 0.6, and all begin well within their limit.

    Args:
        rng: of grips, loads and noise.
        n: objects.
        noise_n: of each force reading.
        sliding_share: sliding over static friction. Near 1 a slip leaves hardly a trace in
            the forces.
    """
    law = Friction(static=0.6, sliding=0.6 * sliding_share)
    objects = HeldObjects(n, law)
    grip = rng.uniform(2.0, 8.0, n)
    rate = rng.uniform(0.3, 2.0, n)
    start = 0.5 * law.static * grip
    detectors = _Detectors(n, law.static)
    slipped = np.full((3, n), np.inf)
    spoke_s = np.full((3, n), np.inf)
    began_s = np.full(n, np.inf)
    # The load is laid on gently, then rises until every object is well under way.
    seconds = 2.5 + float(((0.62 * grip - start) / rate).max())
    for i in range(int(seconds * FORCE_HZ)):
        t = i / FORCE_HZ
        laid_on = 0.5 - 0.5 * np.cos(np.pi * min(t / 2.0, 1.0))
        load = start * laid_on + rate * max(t - 2.0, 0.0)
        shear = objects.advance(load, grip, 1 / FORCE_HZ)
        began_s[(objects.slipped_mm > 0.0) & np.isinf(began_s)] = t
        seen = np.zeros((n, 2))
        seen[:, 0] = shear
        seen += noise_n * rng.normal(size=(n, 2))
        cries = detectors.step(grip + noise_n * rng.normal(size=n), seen)
        new = cries & np.isinf(spoke_s)
        slipped[new] = np.broadcast_to(objects.slipped_mm, new.shape)[new]
        spoke_s[new] = t
    return SlipTrials(slipped, spoke_s - began_s)


def false_alarms_per_hour(
    rng: np.random.Generator, hours: float = 1.0, *, noise_n: float = NOISE_N, contacts: int = 200
) -> Floats:
    """False alarms per contact and hour of holding, float64[3], one a detector.

    Objects of various weights are carried about: grip and shear sway by 10 % within
    seconds, and nothing slips. A train of cries within 0.1 s is one alarm.
    """
    n = int(3600.0 * hours * FORCE_HZ / contacts)
    grip, share = rng.uniform(2.0, 8.0, contacts), rng.uniform(0.3, 0.6, contacts)
    phase = rng.uniform(0.0, 2.0 * np.pi, (3, contacts))
    speed = 2.0 * np.pi * rng.uniform(0.2, 1.0, (3, contacts))
    detectors = _Detectors(contacts, 0.6)
    last = np.full((3, contacts), -np.inf)
    alarms = np.zeros(3)
    for i in range(n):
        t = i / FORCE_HZ
        sway = 0.1 * np.sin(speed * t + phase)
        normal = grip * (1.0 + sway[0])
        shear = (0.6 * share * grip)[:, None] * np.stack([1.0 + sway[1], 0.5 * sway[2]], axis=1)
        cries = detectors.step(
            normal + noise_n * rng.normal(size=contacts),
            shear + noise_n * rng.normal(size=shear.shape),
        )
        alarms += (cries & (t - last > 0.1)).sum(axis=1)
        last[cries] = t
    return alarms / (n * contacts / FORCE_HZ / 3600.0)
