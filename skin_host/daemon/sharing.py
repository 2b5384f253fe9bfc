"""A node's buses shared out among processes that need nothing of each other. Pure.

What shares a bus stays together: parts with a board on it, and fingertips. Each share is a node of
its own, named after the one that is shared: `main-1`, `main-2`, ... Together they make one robot,
because topics of parts do not show the node.
"""

from skin_host.config.settings import Settings, changed, parse_triangles


def share_out(settings: Settings, node: str, n: int) -> list[frozenset[str]]:
    """The buses of each share, as even as may be by triangles; no share is empty.

    Args:
        settings: of the robot.
        node: that is shared.
        n: shares wanted; there are fewer where too many parts share buses.
    """
    bus_of = {name: board.bus for name, board in settings.boards.items()}
    weights: dict[frozenset[str], int] = {}
    for part in settings.parts.values():
        if part.node == node:
            buses = frozenset(bus_of[patch.board] for patch in part.patches)
            triangles = sum(len(parse_triangles(patch.triangles)) for patch in part.patches)
            _join(weights, buses, triangles)
    for tip in settings.fingertips.values():
        if tip.node == node:
            _join(weights, frozenset([tip.bus]), 1)
    shares: list[tuple[int, frozenset[str]]] = [(0, frozenset())] * min(n, len(weights))
    # The largest first, each to the smallest share.
    for buses in sorted(weights, key=lambda one: (-weights[one], sorted(one))):
        smallest = min(range(len(shares)), key=lambda number: shares[number][0])
        weight, others = shares[smallest]
        shares[smallest] = weight + weights[buses], others | buses
    return [buses for _, buses in shares]


def share_of(settings: Settings, node: str, number: int, n: int) -> Settings:
    """Settings in which one share of a node is the node `share_name(node, number)`.

    Args:
        settings: of the robot.
        node: that is shared.
        number: of the share, from 1.
        n: shares wanted, see `share_out`.
    """
    buses = share_out(settings, node, n)[number - 1]
    values: dict[str, object] = {}
    for name, part in settings.parts.items():
        if part.node == node and settings.boards[part.patches[0].board].bus in buses:
            values[f"parts.{name}.node"] = share_name(node, number)
    for name, tip in settings.fingertips.items():
        if tip.node == node and tip.bus in buses:
            values[f"fingertips.{name}.node"] = share_name(node, number)
    if settings.service.metrics_port:
        values["service.metrics_port"] = settings.service.metrics_port + number - 1
    return changed(settings, values)


def share_name(node: str, number: int) -> str:
    """The node that a share is."""
    return f"{node}-{number}"


def _join(weights: dict[frozenset[str], int], buses: frozenset[str], triangles: int) -> None:
    """Add what lies on some buses to what lies on any of them."""
    for others in [others for others in weights if others & buses]:
        triangles += weights.pop(others)
        buses |= others
    weights[buses] = triangles
