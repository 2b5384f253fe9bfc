"""Publishes the daemon's fingertips: their events and their health."""

from collections.abc import Iterable

from skin_host.fingertip.engine import FingertipEngine
from skin_host.fingertip.events import FingertipEvent
from skin_host.fingertip.health import FingertipHealth, FingertipRecord
from skin_host.mqtt.messages import ContactState
from skin_host.mqtt.publisher import Publisher
from skin_host.processing.events import TouchEvent

#: Health is published at once when something changes, otherwise this often.
HEALTH_NS = 1_000_000_000


class FingertipPublisher:
    """Publishes the events and the health of an engine's fingertips.

    Args:
        engine: None if there are no fingertips; then nothing is done.
        publisher: of the daemon.
    """

    def __init__(self, engine: FingertipEngine | None, publisher: Publisher) -> None:
        self._engine = engine
        self._publisher = publisher
        self._health = None if engine is None else FingertipHealth(engine)
        self._published: dict[str, tuple[object, int]] = {}
        self._put_contacts()

    def deliver(self, events: Iterable[FingertipEvent]) -> None:
        """Publish events of the fingertips."""
        if self._engine is None:
            return
        for event in events:
            if isinstance(event, TouchEvent):
                self._publisher.put_touch(event)
            else:
                self._publisher.put_grasp(event)
        self._put_contacts()

    def end(self, t_ns: int) -> None:
        """End all contacts, because the daemon stops."""
        if self._engine is not None:
            self.deliver(self._engine.end_all(t_ns))
            for name in self._engine.tips:
                self._publisher.put_contact(name, "UNKNOWN")

    def _put_contacts(self) -> None:
        for name, state in ({} if self._engine is None else self._engine.tips).items():
            known: ContactState = "ON" if state.tip.touched else "OFF"
            self._publisher.put_contact(name, known if state.tip.feels else "UNKNOWN")

    def records(self, now_ns: int) -> dict[str, FingertipRecord]:
        """The health record of every fingertip."""
        return {} if self._health is None else self._health.records(now_ns)

    def publish_health(self, now_ns: int) -> dict[tuple[str, str], str]:
        """Publish health that changed or is due; return all present faults."""
        if self._health is None:
            return {}
        self._health.tick(now_ns)
        present: dict[tuple[str, str], str] = {}
        for name, record in self._health.records(now_ns).items():
            state = record["state"], [one["code"] for one in record["faults"]]
            published, published_ns = self._published.get(name, (None, 0))
            if published != state or abs(now_ns - published_ns) >= HEALTH_NS:
                self._published[name] = state, now_ns
                self._publisher.put_health(name, record)
            for fault, sentence in zip(record["faults"], record["sentences"], strict=True):
                present[fault["code"], fault["where"]] = sentence
        return present
