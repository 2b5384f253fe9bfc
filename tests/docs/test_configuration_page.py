"""docs/configuration.md names every key with its true default, and no other."""

import ast
import re
from collections.abc import Iterator
from typing import Any, get_args, get_type_hints

import msgspec
import pytest
from msgspec import Struct

from skin_host.config.fields import Name
from skin_host.config.settings import Settings
from tests.support.pages import PAGES

PAGE = PAGES["docs/configuration.md"].read_text()
#: Where a table is told of that is not called by its own key.
HEADINGS = {"patches": "[parts.NAME.patches]", "places": "places = ", "fingertips": "fingertips"}


def tables(struct: type[Struct] = Settings, path: str = "") -> Iterator[tuple[str, type[Struct]]]:
    """Each table of a configuration by its path: `processing.touch`, `buses.NAME`."""
    for name, hint in get_type_hints(struct, include_extras=True).items():
        for inner in structs(hint):
            many = "dict" in str(hint)
            here = f"{path}{name}" + (".NAME" if many else "")
            yield here, inner
            yield from tables(inner, f"{here}.")


def structs(hint: Any) -> list[type[Struct]]:
    if isinstance(hint, type) and issubclass(hint, Struct):
        return [hint]
    return [found for inner in get_args(hint) for found in structs(inner)]


#: But for those that hold nothing but tables.
TABLES = {
    path: table
    for path, table in tables()
    if not all(structs(field.type) for field in msgspec.structs.fields(table))
}


def section(path: str) -> dict[str, str]:
    """The keys that the page tells of a table, with what it says of their defaults."""
    key = path.removesuffix(".NAME").rpartition(".")[2]
    for part in re.split(r"^## ", PAGE, flags=re.MULTILINE)[1:]:
        heading = part.splitlines()[0]
        if f"[{path}]" in heading or (key in HEADINGS and HEADINGS[key] in heading):
            return dict(re.findall(r"^\| `(\w+)` \| (.*?) \|", part, re.MULTILINE))
    raise AssertionError(f"nothing is said of [{path}]")


@pytest.mark.parametrize("path", TABLES)
def test_a_table_is_told_with_its_keys_and_defaults(path: str) -> None:
    told = section(path)
    for field in msgspec.structs.fields(TABLES[path]):
        if structs(field.type) and field.name not in told:
            continue  # a table with a section of its own
        assert field.name in told, f"[{path}] {field.name}"
        assert default(told.pop(field.name)) == true_default(field), f"[{path}] {field.name}"
    assert not told


def default(text: str) -> Any:
    if text in {"required", "none"}:
        return {"required": msgspec.NODEFAULT, "none": None}[text]
    words = text.strip("`").replace("true", "True").replace("false", "False")
    return ast.literal_eval(words)


def true_default(field: msgspec.structs.FieldInfo) -> Any:
    if field.default_factory is not msgspec.NODEFAULT:
        return field.default_factory()
    return field.default


def test_the_characters_of_a_name_are_told() -> None:
    [(most, told)] = re.findall(r"has 1 to (\d+) of the characters (.*?), as topics", PAGE, re.S)
    permitted = re.compile("[" + "".join(re.findall(r"`(.*?)`", told)).replace("-_", "_-") + "]")

    def is_name(text: str) -> bool:
        try:
            return msgspec.convert(text, Name) == text
        except msgspec.ValidationError:
            return False

    assert all(is_name(sign) == bool(permitted.fullmatch(sign)) for sign in map(chr, range(0x300)))
    assert [is_name("a" * n) for n in (0, 1, int(most), int(most) + 1)] == [
        False,
        True,
        True,
        False,
    ]
