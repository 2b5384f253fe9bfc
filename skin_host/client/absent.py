"""What is asked for and cannot come: parts that a robot lacks, and what parts do not publish."""

from collections.abc import Collection, Mapping

from skin_host.client.heard import Described
from skin_host.errors import some_of, visible

#: Of more parts only so many are named.
MOST_NAMED = 20


def no_such_part(robot: str, part: str, names: Collection[str]) -> str:
    """Return that a robot has no such part, and which ones it has."""
    listed = some_of([visible(name, 64) for name in sorted(names)], MOST_NAMED)
    return f'robot "{robot}" has no part "{visible(part, 64)}"; there are: {listed or "none"}'


def unpublished(
    robot: str, part: str | None, kinds: Collection[str], parts: Mapping[str, Described]
) -> str | None:
    """Return why a part that is known publishes nothing of what is asked for; None: it does, or
    may.

    Args:
        robot: its name.
        part: that is asked for; None: all.
        kinds: of what, see `streams.Kind`.
        parts: what is known of the robot's.
    """
    if part is None or part not in parts or not set(kinds) <= {"frame", "slip", "over"}:
        return None
    skin, tip = parts[part].skin, parts[part].fingertip
    here = f'robot "{robot}", part "{visible(part, 64)}"'
    if "frame" not in kinds:
        if skin is None:
            return None
        tips = {name: one.fingertip for name, one in parts.items()}
        covered = [name for name, one in tips.items() if one and one.array == part]
        wanted = " or ".join(f'"{visible(name, 64)}"' for name in covered[:MOST_NAMED])
        return (
            f"{here}: skin has no slips and no excesses; wanted a fingertip on a force/torque "
            f"board{wanted and f', {wanted}'}"
        )
    if skin is not None:
        if skin.frames:
            return None
        return f"{here}: publishes no frames: its configuration has `frames = false`"
    array = None if tip is None else tip.array
    wanted = "a part of skin" if array is None else f'"{visible(array, 64)}", its skin'
    return (
        f"{here}: a fingertip on a force/torque board has no taxels and no frames; wanted {wanted}"
    )
