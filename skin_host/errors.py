"""One exception tree for the whole project.

    SkinError                 anything this project raises on purpose
    |- RequestError           the request itself was wrong (exit status 2)
    |  |- ConfigurationError  a configuration or layout file
    |  |- CalibrationError    a calibration file that is damaged or of another skin
    |  |  |- OtherSkinError   the latter
    |  |- NewerFileError      a file that a newer version has written
    |  |- OtherRobotError     a file that a node of another robot has written
    |  |- LogError            a recording that cannot be read
    |- StateError             right, but not now: nothing was done (exit status 1)
    |  |- BusyFileError       a file that another program is writing at this moment
    |- BusError               the CAN interface: absent, down, refused
    |- BrokerError            the MQTT broker: refused us, or sent an invalid answer

A message is one line: what, where, the value seen, the value wanted, and the command that helps.
The command line prints it (`visible`) and exits with `exit_status`. `nearest` is the word that was
probably meant. `required` imports an extra, or raises.
"""

import importlib
from collections.abc import Iterable, Sequence
from typing import Any


class SkinError(Exception):
    """Base of all errors raised on purpose. `exit_status` is the command line's."""

    exit_status = 1


class RequestError(SkinError):
    """The request was wrong: arguments, configuration, files named by the user."""

    exit_status = 2


class ConfigurationError(RequestError):
    """A configuration or layout file is wrong; the message starts with its path."""


class CalibrationError(RequestError):
    """A calibration file is damaged, or belongs to another configuration."""


class OtherSkinError(CalibrationError):
    """An intact calibration file that belongs to another configuration."""


class NewerFileError(RequestError):
    """A file of the state directory that a newer version has written. It is not changed."""


class OtherRobotError(RequestError):
    """A file of the state directory that a node of another robot has written. It is not changed."""


class StateError(SkinError):
    """The request is right, but not at this moment; nothing was done."""


class BusyFileError(StateError):
    """Another program is writing a file at this moment. systemd starts a service again."""


class LogError(RequestError):
    """A recording cannot be read, or holds nothing of this skin."""


class BusError(SkinError):
    """A CAN interface cannot be used: absent, down, no permission, not CAN."""


class BrokerError(SkinError):
    """The MQTT broker refused us, and waiting does not help."""


def visible(text: str, longest: int = 1000) -> str:
    """Return text with control characters shown as escapes, and cut; anybody may have written it.

    A terminal obeys them: they move the cursor, change the title, hide what was printed before.
    """
    shown = text[:longest] + (" ..." if len(text) > longest else "")
    if shown.isprintable():
        return shown
    return "".join(one if one.isprintable() else repr(one)[1:-1] for one in shown)


def visible_lines(text: str) -> str:
    """Return whole text of several lines, such as a traceback, each as `visible` shows it."""
    return "\n".join(visible(line, len(line)) for line in text.split("\n"))


def some_of(names: Sequence[str], most: int = 20) -> str:
    """Return names as a list in words; of more than so many only the first, and how many."""
    listed = list(names[:most])
    if len(names) > len(listed):
        listed.append(f"... ({len(names)} in all)")
    return ", ".join(listed)


def nearest(typed: str, known: Iterable[str]) -> str | None:
    """Return which of the known words was probably meant, if any."""
    import difflib

    words = {word.strip("-"): word for word in known}
    near = difflib.get_close_matches(typed.strip("-"), words, n=1, cutoff=0.65)
    return words[near[0]] if near else None


def required(module: str, what: str, extra: str) -> Any:
    """Import a module of an extra.

    `what` needs it, in the plural: "MCAP recordings"; `extra` of the project brings it.

    Raises:
        SkinError: it is not installed; the message gives the command that installs it.
    """
    try:
        return importlib.import_module(module)
    except ImportError:
        package = module.partition(".")[0]
        raise SkinError(
            f"{what} need the package {package}, which is not installed; "
            f"mend it with: pip install 'skin-host[{extra}]'"
        ) from None
