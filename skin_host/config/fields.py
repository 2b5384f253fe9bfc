"""Types of single values that several files use."""

from typing import Annotated

from msgspec import Meta

#: Names end up in MQTT topics and in file names. `$` alone would also let a line end pass.
Name = Annotated[str, Meta(pattern=r"^[a-z0-9_-]+(?!\n)$", max_length=64)]
Positive = Annotated[float, Meta(gt=0)]
NotNegative = Annotated[float, Meta(ge=0)]
