"""The daemon's fingertips: what they say goes to the publisher, events and health."""

from skin_host.fingertip.engine import FingertipEngine
from skin_host.fingertip.health import FingertipHealth, FingertipRecord
from skin_host.processing.contacts import TouchEvent
from skin_host.publish.mqtt import Publisher

#: Health is published at once when something changes, else this often.
HEALTH_NS = 1_000_000_000


class FingertipDesk:
    """Publishes for an engine's fingertips.

    Args:
        engine: None where there are none; then nothing is done.
        publisher: of the daemon.
    """

    def __init__(self, engine: FingertipEngine | None, publisher: Publisher) -> None:
        self._engine = engine
        self._publisher = publisher
        self._health = None if engine is None else FingertipHealth(engine)
        self._said: dict[str, tuple[object, int]] = {}

    def deliver(self) -> None:
        """Publish what has happened since the last call."""
        if self._engine is None:
            return
        for event in self._engine.take():
            if isinstance(event, TouchEvent):
                self._publisher.put_touch(event)
            else:
                self._publisher.put_grasp(event)
        for name, state in self._engine.tips.items():
            if state.tip.zeroed:
                self._publisher.put_contact(name, touched=state.tip.touched)

    def end(self, t_ns: int) -> None:
        """End what lasts: the daemon stops."""
        if self._engine is not None:
            self._engine.end_all(t_ns)
            self.deliver()

    def records(self, now_ns: int) -> dict[str, FingertipRecord]:
        """The health record of every fingertip."""
        return {} if self._health is None else self._health.records(now_ns)

    def tell(self, now_ns: int) -> dict[tuple[str, str], str]:
        """Publish health where something changed or it is time; return all faults there are."""
        if self._health is None:
            return {}
        self._health.tick(now_ns)
        told: dict[tuple[str, str], str] = {}
        for name, record in self._health.records(now_ns).items():
            state = record["state"], [one["code"] for one in record["faults"]]
            said, said_ns = self._said.get(name, (None, 0))
            if said != state or abs(now_ns - said_ns) >= HEALTH_NS:
                self._said[name] = state, now_ns
                self._publisher.put_health(name, record)
            for fault, says in zip(record["faults"], record["sentences"], strict=True):
                told[fault["code"], fault["where"]] = says
        return told
