"""Changes of the code that cosmic-ray does not make: what a line does is left out, or mixed up.

cosmic-ray changes operators, numbers and words; each line still runs. These leave out a call, a
value kept in an object, another value of a local variable, an early return or a raised error, and
exchange a call's first two arguments. A local variable's first value is always set: without it
nothing runs, which any test notices.
"""

from collections.abc import Iterator
from typing import Any

import parso

#: Calls that make the same of both orders.
_COMMUTATIVE = {"add", "max", "min", "multiply", "hypot"} | {
    *("maximum", "minimum", "equal", "not_equal", "array_equal", "isclose", "allclose"),
    *("bitwise_and", "bitwise_or", "bitwise_xor", "logical_and", "logical_or", "logical_xor"),
}


class _Operator:
    """What cosmic-ray asks of each, besides the two below."""

    @classmethod
    def arguments(cls) -> tuple[()]:
        return ()


class RemoveStatement(_Operator):
    """A statement that has an effect, replaced by `pass`."""

    def mutation_positions(self, node: Any) -> Iterator[tuple[Any, Any]]:
        if node.type == "simple_stmt" and _has_effect(node.children[0]):
            yield node.children[0].start_pos, node.children[0].end_pos

    def mutate(self, node: Any, index: int) -> Any:
        first = node.children[0]
        prefix = first.get_first_leaf().prefix
        node.children[0] = parso.python.tree.Keyword("pass", first.start_pos, prefix)
        return node


class SwapArguments(_Operator):
    """A call's first two arguments, exchanged, if both are given by place."""

    def mutation_positions(self, node: Any) -> Iterator[tuple[Any, Any]]:
        if node.type == "arglist" and _can_swap(node):
            yield node.start_pos, node.end_pos

    def mutate(self, node: Any, index: int) -> Any:
        first, comma, second, *rest = node.children
        _exchange_prefixes(first, second)
        node.children = [second, comma, first, *rest]
        return node


_OPERATORS = {one.__name__: one for one in (RemoveStatement, SwapArguments)}


class Provider:
    """How cosmic-ray finds them."""

    def __iter__(self) -> Iterator[str]:
        return iter(_OPERATORS)

    def __getitem__(self, name: str) -> Any:
        return _OPERATORS[name]


def _has_effect(statement: Any) -> bool:
    kind = statement.type
    if kind in ("return_stmt", "raise_stmt", "atom_expr", "del_stmt"):
        return True
    if kind == "keyword":
        return bool(statement.value in ("return", "raise"))
    if kind != "expr_stmt":
        return False
    target, what = statement.children[:2]
    if what.type == "annassign":
        return target.type != "name" and len(what.children) > 2
    if what.type != "operator":
        return False
    return what.value != "=" or target.type != "name" or _has_value(target.value, statement)


def _has_value(name: str, statement: Any) -> bool:
    """Whether a local variable has a value before it gets another one in this statement."""
    within = statement.parent
    while within.type not in ("funcdef", "file_input"):
        before = within.get_previous_sibling()
        while before is not None:
            if name in _assigned(before):
                return True
            before = before.get_previous_sibling()
        within = within.parent
    return within.type == "funcdef" and any(one.name.value == name for one in within.get_params())


def _assigned(node: Any) -> list[str]:
    """The local variables that a statement gives values."""
    if node.type != "simple_stmt" or node.children[0].type != "expr_stmt":
        return []
    names = node.children[0].get_defined_names()
    return [one.value for one in names if one.parent.type != "trailer"]


def _can_swap(arguments: Any) -> bool:
    first, _, second = (*arguments.children, None, None)[:3]
    if second is None:
        return False
    leaf = arguments.get_first_leaf().get_previous_leaf().get_previous_leaf()
    if leaf is not None and leaf.value in _COMMUTATIVE:
        return False
    given = all(one.type not in ("argument", "operator") for one in (first, second))
    return given and first.get_code().strip() != second.get_code().strip()


def _exchange_prefixes(first: Any, second: Any) -> None:
    a, b = first.get_first_leaf(), second.get_first_leaf()
    a.prefix, b.prefix = b.prefix, a.prefix
