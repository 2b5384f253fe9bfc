"""Results of simulated runs as text for people, and as one document."""

from pathlib import Path
from typing import Any

from skin_host.evaluation.simulate.promises.chance import too_many
from skin_host.evaluation.simulate.promises.limits import MEASUREMENTS_A_FALSE_TOUCH
from skin_host.evaluation.simulate.run import RunResult, coverage


def line(result: RunResult) -> str:
    """Return the outcome of one seed."""
    speed = result.simulated_s / max(result.cpu_s, 1e-9)
    outcome = "a promise was broken" if result.broken else "every promise held"
    by_chance = f" ({result.by_chance} by noise alone)" if result.by_chance else ""
    return (
        f"seed {result.seed}: {outcome}; {result.simulated_s:.0f} s in {result.cpu_s:.1f} s of CPU "
        f"({speed:.0f} x), {sum(result.troubles.values())} troubles, {result.touches} touch "
        f"events{by_chance}, {result.deaths} ends of the daemon; {result.events} events, "
        f"hash {result.digest}"
    )


def story(result: RunResult, config: Path, hours: float) -> str:
    """Return the events before a broken promise, and the command that repeats them up to a second
    before, with the hash that it must have then.
    """
    command = f"skin simulate {config} --seed {result.seed} --hours {hours:g}"
    over = [one for one in result.seconds if one.at_s <= result.simulated_s - 1.0]
    repeated: list[str] = []
    if over:
        again = over[-1]
        repeated = [
            f"  with logs: {command} --until {again.at_s}",
            f"  which must end with {again.events} events, hash {again.digest}",
        ]
    return "\n".join(
        [
            *(f"  {line}" for line in result.last),
            f"  broken at {result.simulated_s:.3f} s: {result.broken}",
            *repeated,
        ]
    )


def summary(results: list[RunResult]) -> str:
    """Return how many seeds held, how much of the catalogue came, and was named."""
    kinds = coverage(results)
    kept = sum(result.broken is None for result in results)
    n_injected, n_named = len(kinds["injected"]), len(kinds["named"])
    came = f"{n_injected} of {n_injected + len(kinds['never_injected'])} kinds of trouble came"
    named = f"{n_named} of {n_named + len(kinds['never_named'])} that must be named were"
    covered = "; ".join(
        f"{what} (not {', '.join(kinds[missing])})" if kinds[missing] else what
        for what, missing in ((came, "never_injected"), (named, "never_named"))
    )
    touches, measurements = _touched_by_chance(results)
    noise = f"noise alone made {touches} touches in {measurements:.2g} measurements of valid pads"
    if too_many(touches, measurements):
        noise += f": promised is one in {MEASUREMENTS_A_FALSE_TOUCH:.0e} at most"
    return f"{kept} of {len(results)} seeds kept every promise\n{covered}\n{noise}"


def touched_too_often(results: list[RunResult]) -> bool:
    """Return whether noise made more touches than the odds of the touch decision explain."""
    return too_many(*_touched_by_chance(results))


def _touched_by_chance(results: list[RunResult]) -> tuple[int, int]:
    """Return the touches by noise alone of all runs, and their measurements."""
    return sum(result.by_chance for result in results), sum(
        result.measurements for result in results
    )


def document(results: list[RunResult]) -> dict[str, Any]:
    """Return all outcomes for `--json`."""
    return {
        "seeds": len(results),
        "kept": sum(result.broken is None for result in results),
        "simulated_s": round(sum(result.simulated_s for result in results), 3),
        "cpu_s": round(sum(result.cpu_s for result in results), 3),
        "coverage": coverage(results),
        "runs": [
            {
                "seed": result.seed,
                "broken": result.broken,
                "simulated_s": round(result.simulated_s, 6),
                "events": result.events,
                "hash": result.digest,
                "troubles": result.troubles,
                "named": result.named,
                "touches": result.touches,
                "deaths": result.deaths,
                "touches_by_noise": result.by_chance,
                "measurements": result.measurements,
            }
            for result in results
        ],
    }
