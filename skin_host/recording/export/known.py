"""What a client would have known of a robot's parts while their messages were recorded.

A daemon that is killed, restarted or cut off ends nothing: its contacts and the last pressures of
its parts would look as if they lasted until the same part is received again.
"""

from typing import NamedTuple

from skin_host.client.heard import is_online
from skin_host.client.presence import STALE_S, Presence
from skin_host.mqtt.messages import ContactState
from skin_host.processing.events import Touch

#: It is looked this often whether a part is still known while others are received.
LOOK_NS = 500_000_000
#: A recording without frames and health, as one that was filtered to contact states, shows nothing
#: of a part but these, which are published every 2 to 3 s.
CONTACT_STALE_S = 2 * STALE_S


class ContactLine(NamedTuple):
    """Contact state of a part, from this time on."""

    part: str
    t_ns: int
    state: ContactState


class Gone(NamedTuple):
    """From this time on nothing is known of a part, until it is received again."""

    part: str
    t_ns: int


class Known:
    """Follows recorded messages in their order; times are those at which they were recorded.

    Attributes:
        contacts: contact states as they change, UNKNOWN while nothing is known.
        gone: when parts ceased to be known, in the time of their own messages.

    Args:
        stale_s: a part of which nothing was recorded for this long is not known.
    """

    def __init__(self, stale_s: float) -> None:
        self.contacts: list[ContactLine] = []
        self.gone: list[Gone] = []
        self._presence = Presence(stale_s)
        self._states: dict[str, ContactState] = {}
        self._parts: dict[str, bool] = {}
        #: By part: the time in its last message that has one, and when that was recorded.
        self._sent_ns: dict[str, tuple[int, int]] = {}
        self._looked_ns = 0

    def status(self, node: str, payload: bytes, t_ns: int) -> None:
        """Take the status of a node."""
        self._look_if_late(t_ns)
        online = is_online(payload, None, is_only_broker=True)
        self._presence.take_node(node, online, t_ns * 1e-9)
        self._look(t_ns)

    def info(self, node: str, parts: list[str], t_ns: int) -> None:
        """Take which parts a node has."""
        self._presence.take_info(node, parts, t_ns * 1e-9)
        self._look(t_ns)

    def state(self, part: str, state: ContactState, t_ns: int, stored: bool) -> None:
        """Take the contact state of a part; one that the broker had stored may be from any time."""
        self._look_if_late(t_ns)
        self._presence.take_state(part, state, t_ns * 1e-9, stored=stored)
        self._look(t_ns)

    def touch(self, touch: Touch, t_ns: int) -> None:
        """Take a touch."""
        self._look_if_late(t_ns)
        self._sent_ns[touch.part] = touch.t_ns, t_ns
        self._presence.take_touch(touch, t_ns * 1e-9)
        self._look(t_ns)

    def frame(self, part: str, t_ns: int, sent_ns: int) -> None:
        """Take a frame of a part, which has a time of its own."""
        self._look_if_late(t_ns)
        self._sent_ns[part] = sent_ns, t_ns
        self._presence.take_data(part, t_ns * 1e-9)
        self._look_if_gone(part, t_ns)

    def health(self, part: str, t_ns: int) -> None:
        """Take a health record of a part."""
        self._look_if_late(t_ns)
        self._presence.take_sign(part, t_ns * 1e-9)
        self._look_if_gone(part, t_ns)

    def _look_if_gone(self, part: str, t_ns: int) -> None:
        if self._parts.get(part) is False:  # it may be known again
            self._look(t_ns)

    def _look_if_late(self, t_ns: int) -> None:
        if abs(t_ns - self._looked_ns) >= LOOK_NS:
            self._look(t_ns)

    def _look(self, t_ns: int) -> None:
        self._looked_ns = t_ns
        for contact in self._presence.changes(t_ns * 1e-9):
            if self._states.get(contact.part) != contact.state:
                self._states[contact.part] = contact.state
                self.contacts.append(ContactLine(contact.part, t_ns, contact.state))
        for part in self._presence.parts:
            is_received = self._presence.is_received(part, t_ns * 1e-9)
            if self._parts.get(part) and not is_received:
                sent_ns, recorded_ns = self._sent_ns.get(part, (t_ns, t_ns))
                self.gone.append(Gone(part, sent_ns + max(1, t_ns - recorded_ns)))
            self._parts[part] = is_received
