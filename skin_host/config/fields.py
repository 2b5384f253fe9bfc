"""Types of single values that several files use."""

from typing import Annotated

from msgspec import Meta

from skin_host.errors import visible

#: Names end up in MQTT topics and in file names. `$` alone would also let a line end pass.
Name = Annotated[str, Meta(pattern=r"^[a-z0-9_-]+(?!\n)$", max_length=64)]
Positive = Annotated[float, Meta(gt=0)]
NotNegative = Annotated[float, Meta(ge=0)]


def wrong_topic(text: str) -> str | None:
    """Return what is wrong with the first words of topics; None if nothing is."""
    is_split = text.startswith(("/", "$")) or text.endswith("/")
    if text and text.isprintable() and not set(text) & set("+#") and not is_split:
        return None
    return (
        f'"{visible(text, 80)}" cannot start a topic; wanted words such as skin or lab/skin, '
        "without +, #, control characters and a slash at either end"
    )
