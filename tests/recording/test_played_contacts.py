"""The contact states of a recording that is played are those that a daemon publishes."""

from dataclasses import replace

from skin_host.config.settings import load
from skin_host.processing.calibration import Verdict
from skin_host.processing.core import Engine
from skin_host.recording.replay import contacts_of
from tests.mqtt.test_contact import CONFIG, LAYOUT, PART, begin, frame
from tests.support.fault_bench import FaultBench


def test_a_taxel_without_a_zero_keeps_no_contact_unknown() -> None:
    """It will never be valid, so nothing can confirm there that the contact is over."""
    known = FaultBench().engine.calibration
    assert known is not None
    verdict = known.verdict.copy()
    taxel = LAYOUT.parts[PART].start + 3
    verdict[taxel] = Verdict.TOO_FEW
    engine = Engine(load(CONFIG), LAYOUT, [PART], replace(known, verdict=verdict))
    contact = contacts_of(engine)[PART]
    blind = slice(3, 4)
    period_ns = 50_000_000
    decides = engine.measurements()
    assert decides is not None
    assert decides[taxel] == 0
    enough = int(decides.max())
    states = [contact.step(frame(n * period_ns, blind=blind), []) for n in range(enough)]
    assert states[-1] == "OFF"
    contact.step(frame(100 * period_ns, [4], blind=blind), [begin([3, 4])])
    lost = [begin([3, 4]).ended(2, 2, "lost")]
    states = [contact.step(frame(101 * period_ns, blind=blind), lost)]
    states += [contact.step(frame((102 + n) * period_ns, blind=blind), []) for n in range(enough)]
    assert (states[0], states[-1]) == ("UNKNOWN", "OFF")
