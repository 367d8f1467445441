"""Success against environment steps and against minutes on other people's tasks: ours, and TQC with hindsight of Stable-Baselines3 and SBX.

python -m benchmarks.time_to_solve                                   # the four Fetch tasks, 3 seeds, at most 15 minutes each: hours
python -m benchmarks.time_to_solve --tasks FetchPush --learners hindrl sb3-demos --seeds 2 --minutes 5
python -m benchmarks.time_to_solve --only-report                     # the table and the plot of what is there

A cell is a task, a learner and a seed. Each is a process of its own, one after the other, and writes a file when it is over; cells whose files are
there are not run again, so a benchmark that was interrupted goes on. A cell ends after its minutes or its steps, or when two evaluations in a row
have reached 95%. An episode is a success where the goal is held at its last step, as papers count; what reaches it at some step is told, too. All
learners are judged by the same fresh episodes, `peers/episodes.py`; seconds count from the start of the process, compilation included and evaluations
not.

Learners are `hindrl` and `bc`, ours by the default recipe, with demonstrations of the task's expert; `sb3`, TQC with hindsight by the settings of the
RL Zoo; `sbx`, the same algorithm in JAX with networks and batches of a size for CPUs; and `sb3-demos` and `sbx-demos`, with those demonstrations in
their replay buffers.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import hindrl_jax
from benchmarks import report
from benchmarks.run import FOLDER
from hindrl_jax.base.environments import action_to_env
from hindrl_jax.plotting.figures import colours, figure, legend_beside, mark_success

TASKS = {"FetchReach": (5_000, 500), "FetchPush": (75_000, 5_000), "FetchPickAndPlace": (150_000, 10_000), "FetchSlide": (500_000, 25_000)}
"""Environment steps of a run, and between two evaluations."""
LABELS = {
    "hindrl": "ours, HinDRL",
    "bc": "ours, behaviour cloning",
    "sbx-demos": "SBX",
    "sbx": "SBX",
    "sb3-demos": "Stable-Baselines3",
    "sb3": "Stable-Baselines3",
}
"""Of the learners, in the plot."""
LEARNERS = tuple(LABELS)
SOLVED = 0.95
VERSION, MODULE = "v4", "gymnasium_robotics"

Row = dict[str, Any]
"""A cell: what it is, and its points, {"steps", "seconds", "reached", "held"}."""


@dataclasses.dataclass(frozen=True)
class Cell:
    """One run of one learner."""

    task: str
    learner: str
    num_demos: int
    seed: int

    @property
    def name(self) -> str:
        return f"{self.task}_{self.learner}_{self.num_demos}_{self.seed}"

    def check_same(self, row: Row, given: argparse.Namespace) -> None:
        """Makes sure that a cell that is there was run as this one is asked for.

        Raises:
          SystemExit: if it was not.
        """
        for name, asked in settings(self, given).items():
            if row.get(name) != asked:
                sys.exit(f"{given.out}/{self.name}.json was run with --{name} {row.get(name)}, not {asked}: choose another --out, or remove it")

    @property
    def ours(self) -> bool:
        return self.learner in ("hindrl", "bc")


def arguments(given: Sequence[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.time_to_solve", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=list(TASKS))
    parser.add_argument("--learners", nargs="+", choices=LEARNERS, default=list(LEARNERS))
    parser.add_argument("--demos", type=int, default=20, help="demonstrations (default: 20)")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--seed", type=int, default=0, help="the first one; the others follow it")
    parser.add_argument("--minutes", type=float, default=15.0, help="of a cell, evaluations not counted (default: 15)")
    parser.add_argument("--steps", type=int, help="environment steps of a cell, in place of those of its task")
    parser.add_argument("--episodes", type=int, default=50, help="of an evaluation (default: 50)")
    parser.add_argument("--peers", type=Path, default=FOLDER / ".venv/bin/python", metavar="PYTHON", help="interpreter that has the peers")
    parser.add_argument("--out", type=Path, default=FOLDER / "time_to_solve", metavar="FOLDER")
    parser.add_argument("--only-report", action="store_true", help="run nothing")
    return parser.parse_args(given)


def main() -> None:
    given = arguments()
    given.out.mkdir(parents=True, exist_ok=True)
    if not given.only_report:
        seeds = range(given.seed, given.seed + given.seeds)
        for task, seed, learner in itertools.product(given.tasks, seeds, given.learners):
            cell = Cell(task, learner, 0 if learner in ("sb3", "sbx") else given.demos, seed)
            if not cell.ours and not given.peers.exists():
                print(f"{cell.name}: left out, {given.peers} is not there: `make bench` installs the peers; or name their interpreter with --peers")
                continue
            path = given.out / f"{cell.name}.json"
            if path.exists():
                cell.check_same(json.loads(path.read_text()), given)
            else:
                print(f"{cell.name} ...", flush=True)
                write(path, json.dumps(run(cell, given)))
    rows = [json.loads(path.read_text()) for path in sorted(given.out.glob("*.json"))]
    if not rows:
        sys.exit(f"{given.out} holds no results: run without --only-report")
    plot(rows, given.out / "time_to_solve.png")
    text = table(rows)
    write(given.out / "time_to_solve.md", text)
    print(text)


def settings(cell: Cell, given: argparse.Namespace) -> dict[str, float]:
    """How far a cell is run, and by how many episodes it is judged."""
    return {"minutes": given.minutes, "steps": given.steps or TASKS[cell.task][0], "episodes": given.episodes}


def write(path: Path, text: str) -> None:
    """At once or not at all."""
    part = path.with_suffix(f"{path.suffix}.part")
    part.write_text(text)
    os.replace(part, path)


def run(cell: Cell, given: argparse.Namespace) -> Row:
    """Runs a cell to its end.

    Raises:
      SystemExit: if its process fails.
    """
    command = ["--env", f"{cell.task}-{VERSION}", "--module", MODULE, "--seed", cell.seed, "--every", TASKS[cell.task][1]]
    command += ["--steps", settings(cell, given)["steps"], "--episodes", given.episodes]
    if cell.num_demos:
        command += ["--demos", demonstrations(cell, given.out)]
    if cell.ours:
        command = [sys.executable, "-m", "benchmarks.solve_ours", "--algo", cell.learner, *command]
    else:
        library = "sbx" if cell.learner.startswith("sbx") else "sb3_contrib"
        command = [given.peers, FOLDER / "peers/solve_sb3.py", "--library", library, *command]
    errors = given.out / f"{cell.name}.log"
    busy = os.getloadavg()[0] / (os.cpu_count() or 1)
    with errors.open("w") as log:
        process = subprocess.Popen(list(map(str, command)), stdout=subprocess.PIPE, stderr=log, text=True, cwd=FOLDER.parent)
        hangs = threading.Event()

        def stop() -> None:  # evaluations take time that does not count, so this is for what hangs alone
            hangs.set()
            process.kill()

        limit = threading.Timer(60 * given.minutes * 3, stop)
        limit.start()
        points = read_points(process, 60.0 * given.minutes)
        ended = process.poll() is not None
        process.kill()
        limit.cancel()
        status = process.wait()
        process.stdout.close()
    if ended and status and not hangs.is_set():
        sys.exit(f"{cell.name} failed: {errors} says why")
    errors.unlink()
    measured = {"date": time.strftime("%Y-%m-%d"), "machine": report.machine(), "busy": round(busy, 2), "stopped": hangs.is_set()}
    return dataclasses.asdict(cell) | settings(cell, given) | measured | {"points": points}


def read_points(process: subprocess.Popen[str], seconds: float) -> list[dict[str, float]]:
    """The points that a worker prints, until it ends, its time is over or it has solved the task twice in a row."""
    points: list[dict[str, float]] = []
    for line in process.stdout or ():
        point = json.loads(line)
        if point["seconds"] > seconds:
            break
        print(
            f"    {point['steps']:9,d} steps {point['seconds'] / 60:6.1f} min   reached {point['reached']:4.0%}   held {point['held']:4.0%}",
            flush=True,
        )
        points.append(point)
        if len(points) > 1 and min(each["held"] for each in points[-2:]) >= SOLVED:
            break
    else:
        process.wait()
    return points


def demonstrations(cell: Cell, folder: Path) -> Path:
    """The file of a cell's demonstrations, the same for all learners with a seed; recorded where it is not there."""
    path = folder / f"{cell.task}_{cell.num_demos}_{cell.seed}{'.hdf5' if cell.ours else '.npz'}"
    if not path.exists():
        env = hindrl_jax.make(f"gymnasium:{cell.task}-{VERSION}")
        recorded = hindrl_jax.record_demonstrations(env, cell.num_demos, seed=cell.seed)
        if cell.ours:
            hindrl_jax.save_demonstrations(path, recorded, env=env, env_args=dataclasses.asdict(env))
        else:
            save_episodes(path, recorded, env)
    return path


def save_episodes(path: Path, recorded: Any, env: Any) -> None:
    """Episodes as a peer can read them: what was observed (N, T + 1, ...), goals (N, G), actions in the environment's own units, lengths."""
    goals = np.asarray(env.achieved_goal(recorded.observations))
    np.savez(
        path,
        observation=np.asarray(recorded.observations)[..., : -goals.shape[-1]],
        achieved_goal=goals,
        desired_goal=np.asarray(recorded.desired_goals),
        actions=np.asarray(action_to_env(recorded.actions, env)),
        lengths=np.asarray(recorded.lengths),
    )


def solved(row: Row) -> dict[str, float] | None:
    """The first point of a cell at 95%; None where it never got there."""
    return next((point for point in row["points"] if point["held"] >= SOLVED), None)


def groups(rows: Sequence[Row]) -> dict[tuple[str, str, int], list[Row]]:
    """Cells that differ in their seed alone, by task, learner and number of demonstrations."""
    found: dict[tuple[str, str, int], list[Row]] = {}
    order = sorted(rows, key=lambda row: (list(TASKS).index(row["task"]), LEARNERS.index(row["learner"]), -row["num_demos"], row["seed"]))
    for row in order:
        found.setdefault((row["task"], row["learner"], row["num_demos"]), []).append(row)
    return found


def table(rows: Sequence[Row]) -> str:
    """A line for each task and learner: seeds that reach 95%, median steps and minutes to it, and the best and the last evaluation."""
    lines = []
    for (task, learner, num_demos), cells in groups(rows).items():
        first = [point for point in map(solved, cells) if point]
        most = [max((point["held"] for point in row["points"]), default=0.0) for row in cells]
        reached = [row["points"][-1]["reached"] if row["points"] else 0.0 for row in cells]
        spent = [(row["points"][-1]["steps"], row["points"][-1]["seconds"] / 60) for row in cells if row["points"]]
        every = len(first) == len(cells)
        lines.append(
            [
                task,
                f"`{learner}`",
                num_demos,
                f"{len(first)}/{len(cells)}",
                f"{np.median([point['steps'] for point in first]):,.0f}" if every else "",
                f"{np.median([point['seconds'] for point in first]) / 60:.1f}" if every else "",
                f"{np.mean(most):.0%} ({min(most):.0%})",
                f"{np.mean(reached):.0%}",
                " ".join(f"{steps:,} / {minutes:.0f}" for steps, minutes in spent),
            ]
        )
    header = ["task", "learner", "demonstrations", "seeds at 95%", "steps to it, median", "minutes to it, median"]
    return report.table([*header, "best, mean (worst)", "reached at some step in the end, mean", "steps / minutes of each run"], lines)


def plot(rows: Sequence[Row], path: Path) -> None:
    """Success of each run against steps and against minutes, a row of axes for each task."""
    tasks = list(dict.fromkeys(task for task, _, _ in groups(rows)))
    colour_of = dict(zip(LABELS, colours("viridis", len(LABELS), end=0.9), strict=True))
    with figure(path, len(tasks), 2, figsize=(11, 2.6 * len(tasks)), sharey=True) as (_, axes):
        for (task, learner, num_demos), cells in groups(rows).items():
            beside = axes[2 * tasks.index(task) :][:2]
            for index, row in enumerate(cells):
                points = [{"steps": 0, "seconds": 0.0, "held": 0.0}, *row["points"]]
                label = f"{LABELS[learner]}, {num_demos or 'no'} demonstrations" if index == 0 else None
                for axis, name, scale in zip(beside, ("steps", "seconds"), (1, 1 / 60), strict=True):
                    x, y = [scale * point[name] for point in points], [100 * point["held"] for point in points]
                    axis.plot(x, y, color=colour_of[learner], linewidth=1.5, label=label)
        for task, left, right in zip(tasks, axes[::2], axes[1::2], strict=True):
            mark_success(left)
            mark_success(right)
            left.set(xlabel="environment steps")
            right.set(xlabel="minutes", ylabel="")
            left.xaxis.set_major_formatter("{x:,.0f}")
            left.set_title(f"{task}, each line a seed", loc="left")
            legend_beside(right)


if __name__ == "__main__":
    main()
