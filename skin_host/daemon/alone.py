"""One daemon at a time has the boards and the files of a node.

A second one would set the boards up while the first one reads them: what presses them then is in
their new zero.
"""

import contextlib
import fcntl
import os
from collections.abc import Iterator

from skin_host.config.settings import Settings
from skin_host.daemon.state import kept_path
from skin_host.errors import StateError


@contextlib.contextmanager
def alone(settings: Settings, node: str) -> Iterator[None]:
    """In the block, nobody else on this computer gets into such a block of this node.

    Who has the node holds a lock on a file of the state directory, which the system takes back
    whatever becomes of the process. Where there can be no such file, or no locks, others are not
    noticed.

    Args:
        settings: of the robot.
        node: the daemon.

    Raises:
        StateError: a daemon of this node is running, or its boards are being calibrated.
    """
    path = kept_path(settings, node, "lock").with_suffix("")  # it holds no JSON
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(OSError):
            path.parent.mkdir(parents=True, exist_ok=True)
            # Without waiting, should a pipe be in its place.
            how = os.O_RDONLY | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK
            descriptor = os.open(path, how, 0o644)
            stack.callback(os.close, descriptor)
            with contextlib.suppress(OSError):  # another user's, or a disk that is read-only by now
                # Whoever may enter the folder must be able to open it, to be refused.
                os.fchmod(descriptor, 0o644)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise StateError(
                    f'{path}: node "{node}" of robot "{settings.robot}" is running, and another '
                    "daemon would zero its boards: ask it with `skin command`, or stop it"
                ) from None
        yield
