"""Taking turns: whatever is compared is timed alternately, so that a busy minute of the machine falls on all alike; medians are reported."""

from __future__ import annotations

import dataclasses
import statistics
import time
from collections.abc import Callable, Hashable, Mapping
from pathlib import Path
from typing import Any

import jax

Row = dict[str, Any]
"""One line of results.json."""


@dataclasses.dataclass(frozen=True)
class Effort:
    """How long to measure."""

    rounds: int
    """Turns of each contestant."""
    turn_seconds: float
    """Least length of a turn."""


@dataclasses.dataclass(frozen=True)
class Options:
    """What the parts of the benchmark are asked for."""

    effort: Effort
    quick: bool
    """Only a sample of each part, to see that it works."""
    cores: int
    peers: Path | None
    """Python interpreter of the peers; None leaves them out."""


@dataclasses.dataclass(frozen=True)
class Cost:
    """Seconds that a turn took."""

    cpu: float
    """CPU time of all threads of the process that did the work."""
    wall: float


@dataclasses.dataclass(frozen=True)
class Contestant:
    """Something to be timed."""

    turn: Callable[[int], Cost]
    """Makes that many calls and comes back when their results are computed."""
    units: int = 1
    """How many of what is counted (gradient steps, environment steps, ...) one call does."""


def calls(call: Callable[[], Any], *, units: int = 1) -> Contestant:
    """A contestant in this process: a function that comes back when its results are computed."""

    def turn(num_calls: int) -> Cost:
        wall, cpu = time.perf_counter(), time.process_time()
        for _ in range(num_calls):
            call()
        return Cost(cpu=time.process_time() - cpu, wall=time.perf_counter() - wall)

    return Contestant(turn, units)


def advancing(program: Callable[..., Any], state: Any, *inputs: Any) -> Callable[[], None]:
    """A call of program(state, *inputs) that goes on from what the last call returned; the program may have the state donated."""

    def call() -> None:
        nonlocal state
        state = jax.block_until_ready(program(state, *inputs))

    return call


def take_turns(contestants: Mapping[Hashable, Contestant], effort: Effort) -> dict[Hashable, Row]:
    """Times contestants round-robin, after a call each to warm up and one more to learn how many calls make a turn.

    Returns:
      For each contestant the milliseconds per unit: the median over its turns as `cpu_ms` and `wall_ms`, the least and the largest as
      `cpu_ms_range` and `wall_ms_range`; and how many turns and units per turn that was.
    """
    num_calls = {}
    for name, contestant in contestants.items():
        contestant.turn(1)
        num_calls[name] = max(1, round(effort.turn_seconds / contestant.turn(1).wall))
    costs: dict[Hashable, list[Cost]] = {name: [] for name in contestants}
    for _ in range(effort.rounds):
        for name, contestant in contestants.items():
            costs[name].append(contestant.turn(num_calls[name]))
    return {name: _summary(costs[name], num_calls[name] * contestant.units) for name, contestant in contestants.items()}


def _summary(costs: list[Cost], units: int) -> Row:
    row: Row = {}
    for clock in ("cpu", "wall"):
        each = [1000.0 * getattr(cost, clock) / units for cost in costs]
        row[f"{clock}_ms"] = rounded(statistics.median(each))
        row[f"{clock}_ms_range"] = [rounded(min(each)), rounded(max(each))]
    return row | {"rounds": len(costs), "units_per_turn": units}


def rounded(value: float) -> float:
    """To five significant digits."""
    return float(f"{value:.5g}")


def busy_share(seconds: float = 1.0) -> float | None:
    """Which share of the cores others use: that of all CPU time while this process sleeps. None where there is no /proc."""

    def ticks() -> tuple[int, int]:
        fields = [int(word) for word in Path("/proc/stat").read_text().partition("\n")[0].split()[1:9]]
        return sum(fields), fields[3] + fields[4]  # all, of which idle and waiting for disks

    if not Path("/proc/stat").exists():
        return None
    total, idle = ticks()
    time.sleep(seconds)
    total, idle = (after - before for after, before in zip(ticks(), (total, idle), strict=True))
    return round(1.0 - idle / total, 3)


def milliseconds(row: Row, clock: str) -> str:
    """The median with the least and the largest turn behind it, e.g. `54.1 (53.8 .. 56.0)`."""
    least, largest = row[f"{clock}_ms_range"]
    return f"{short(row[f'{clock}_ms'])} ({short(least)} .. {short(largest)})"


def short(value: float) -> str:
    """With three digits or more, never with an exponent for what is large."""
    return f"{value:,.0f}" if value >= 100.0 else f"{value:.3g}"


def line(name: str, row: Row) -> str:
    """A row to be printed while the benchmark runs."""
    return f"  {name:40s} CPU {milliseconds(row, 'cpu'):>28s} ms   wall {milliseconds(row, 'wall'):>28s} ms"
