"""Groups touched taxels into contacts and follows the contacts over time.

`tracker` does it, frame by frame. What it needs for that is apart: which taxels are next to each
other (`neighbours`), what lost frames hide for a moment (`held`), which contact a patch of taxels
continues (`grouping`), where it is (`places`), and why one ends when the rules change (`former`).
"""

from skin_host.processing.contacts.former import Decision
from skin_host.processing.contacts.held import LOST_NS
from skin_host.processing.contacts.tracker import (
    ALIVE_NS,
    MOVED_M,
    PRESSED_SHARE,
    ContactTracker,
)

__all__ = ["ALIVE_NS", "LOST_NS", "MOVED_M", "PRESSED_SHARE", "ContactTracker", "Decision"]
