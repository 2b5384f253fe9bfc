"""Stop when a part is touched, or may be. `python examples/stop_on_touch.py PART [URL]`."""

import signal
import sys

from skin_host.client import Contact, SkinCallbacks, SkinError


def on_contact(contact: Contact) -> None:
    """Let the motor move only while it is known that nothing touches."""
    if contact.touched:  # ON, and UNKNOWN for whatever reason
        print("stop", contact.why or "touched", flush=True)
    else:
        print("move", flush=True)


if len(sys.argv) not in (2, 3) or "/" in sys.argv[1]:  # which a URL has, and the name of no part
    sys.exit("which part? python examples/stop_on_touch.py PART [URL]")
for ends in (signal.SIGTERM, signal.SIGHUP):  # else the motor would not be stopped then
    signal.signal(ends, lambda number, _: sys.exit(128 + number))
print("stop", "until something is known", flush=True)
try:
    with SkinCallbacks(*sys.argv[2:]) as skin:
        skin.on_contact(on_contact, part=sys.argv[1])
        sys.stdin.read()
except SkinError as error:  # no broker, or no robot there
    sys.exit(str(error))
except KeyboardInterrupt:
    pass
finally:
    print("stop", "the program ends", flush=True)
