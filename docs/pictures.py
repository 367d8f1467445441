"""Draws the pictures of README and of the pages: docs/how_it_works.png, environments.png, epsilon_filter.png, cable_expert.png, values.png and, of
the runs that are there, docs/panda.gif, docs/grid.gif, docs/fetch.gif and docs/grid_curve.png. docs/gallery.md shows most of them together.

    hindrl train --env FixedGridPickAndPlace --demos 1 --seed 2 --stop-at 0.98 --out runs/quickstart
    hindrl train --env FixedParameterizedReach --demos 1 --seed 0 --stop-at 0.98 --out runs/reach
    hindrl train --env gymnasium:FetchPickAndPlace-v4 --demos 20 --seed 0 --steps 100000 --stop-at 0.95 --out runs/fetch
    python docs/pictures.py
"""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
from PIL import Image, ImageSequence

from hindrl_jax import cli
from hindrl_jax.envs.cable import viewer as cable_viewer
from hindrl_jax.envs.grid import viewer as grid_viewer
from hindrl_jax.envs.reach import viewer as reach_viewer
from hindrl_jax.runs.reader import load_run
from hindrl_jax.tasks.registry import make
from hindrl_jax.training.recording import record_demonstrations

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch, Rectangle

DOCS = Path(__file__).parent
RUNS = Path("runs")
DEMO, ROLLOUT, RELABELLED, NETWORK, INK = "#d9822b", "#8a97a6", "#2f6fb3", "#4b8f5b", "#1c2733"


def main() -> None:
    """Draws what can be drawn here."""
    how_it_works(DOCS / "how_it_works.png")
    environments(DOCS / "environments.png")
    epsilon_filter(DOCS / "epsilon_filter.png")
    values(DOCS / "values.png")
    cable_expert(DOCS / "cable_expert.png")
    for run, film in (("reach", "panda.gif"), ("quickstart", "grid.gif"), ("fetch", "fetch.gif")):
        if (RUNS / run).is_dir():
            cli.main(["render", str(RUNS / run), "--to", str(DOCS / film)])
            if run == "fetch":
                crop(DOCS / film, (0, 70, 400, 470))
    if (RUNS / "quickstart").is_dir():
        shutil.copy(RUNS / "quickstart" / "curve.png", DOCS / "grid_curve.png")


def how_it_works(path: Path) -> None:
    """Demonstrations and rollouts, the goals of the demonstrations, one batch of three kinds of rows, and what learns from it."""
    figure, axes = plt.subplots(figsize=(10, 4.1), dpi=144)
    axes.set(xlim=(0, 100), ylim=(0, 41))
    axes.axis("off")

    def box(x: float, y: float, width: float, height: float, title: str, text: str, colour: str) -> None:
        axes.add_patch(
            FancyBboxPatch((x, y), width, height, boxstyle="round,pad=0,rounding_size=1.2", facecolor="white", edgecolor=colour, linewidth=2)
        )
        axes.text(x + width / 2, y + height - 2.6, title, ha="center", va="center", fontsize=11, color=colour, weight="bold")
        axes.text(x + width / 2, y + (height - 4) / 2, text, ha="center", va="center", fontsize=9, color=INK, linespacing=1.4)

    def arrow(start: tuple[float, float], end: tuple[float, float], text: str = "", at: tuple[float, float] = (0, 0)) -> None:
        axes.add_patch(FancyArrowPatch(start, end, arrowstyle="-|>", mutation_scale=14, color=INK, linewidth=1.3))
        axes.text(*at, text, ha="center", va="center", fontsize=8.5, color=INK, linespacing=1.3)

    box(0, 27, 22, 12, "demonstrations", "a few solved episodes,\nactions may be noisy", DEMO)
    box(0, 4, 22, 12, "rollouts", "episodes of the policy,\nkept in a replay buffer", ROLLOUT)
    box(28, 18.8, 18, 12, "goals", "states that the\ndemonstrations\nreached", DEMO)

    rows = ((30, DEMO, "demonstrated", "reward 1 at the end"), (19, RELABELLED, "relabelled", "reward 1 where the\nnew goal is reached"))
    axes.text(64, 39.4, "one batch", ha="center", va="center", fontsize=11, color=INK, weight="bold")
    for y, colour, name, note in (*rows, (8, ROLLOUT, "original", "reward 1 if solved")):
        axes.add_patch(Rectangle((55, y - 3.5), 18, 10.5, facecolor=colour, alpha=0.16, edgecolor=colour, linewidth=2))
        axes.text(64, y + 4.2, name, ha="center", va="center", fontsize=10, color=INK, weight="bold")
        axes.text(64, y - 0.4, note, ha="center", va="center", fontsize=8.5, color=INK, linespacing=1.2)

    batch = {"boxstyle": "round,pad=0,rounding_size=1.2", "facecolor": "none", "edgecolor": INK, "linewidth": 1.3}
    axes.add_patch(FancyBboxPatch((53.8, 3.3), 20.4, 34.2, **batch))  # around all three, since critics and actor learn from all of them

    box(80, 25, 20, 12, "critics", "the value of an action\nfor a goal", NETWORK)
    box(80, 4, 20, 13, "actor", "the policy: high value,\nand like what the\ndemonstrations do", NETWORK)

    arrow((22, 33), (53.8, 33))
    arrow((22, 29.5), (28, 27))
    arrow((46, 23.5), (53.8, 23.5))
    arrow((22, 13), (53.8, 18.5), "with another goal", (39, 12.9))
    arrow((22, 8), (53.8, 8), "as recorded", (39, 6.4))
    arrow((74.2, 20.7), (80, 28))
    arrow((74.2, 20.7), (80, 13))
    arrow((90, 25), (90, 17), "value", (93.5, 21))
    axes.plot([90, 90, 11, 11], [4, 0.6, 0.6, 2], color=INK, linewidth=1.3)
    arrow((11, 0.6), (11, 4), "plays the next episodes", (50, 2))
    figure.savefig(path, bbox_inches="tight", pad_inches=0.05, facecolor="white")
    plt.close(figure)


def environments(path: Path) -> None:
    """A first state of each kind of task, side by side."""
    pictures = []
    for name, viewer in (("FixedGridPickAndPlace", grid_viewer), ("FixedParameterizedReach", reach_viewer), ("CableInsertion", cable_viewer)):
        env = make(name)
        state, _ = env.reset(jax.random.key(1))
        pictures.append(Image.fromarray(np.asarray(viewer.frame(env, state))))
    height = min(picture.height for picture in pictures)
    pictures = [picture.resize((round(picture.width * height / picture.height), height), Image.Resampling.LANCZOS) for picture in pictures]
    together = Image.new("RGB", (sum(picture.width for picture in pictures) + 20 * (len(pictures) - 1), height), "white")
    x = 0
    for picture in pictures:
        together.paste(picture, (x, 0))
        x += picture.width + 20
    together.save(path, optimize=True)


def values(path: Path) -> None:
    """What the critics of the grid's shipped run say along an episode, and with the agent in each cell; the program is that of docs/python.md."""
    run = load_run("policy:FixedGridPickAndPlace")
    episode, value, env = run.play(1, key=jax.random.key(300)), run.value(), run.spec.env
    start = episode.states[0, 0]
    cells = jnp.stack(jnp.meshgrid(jnp.arange(env.size), jnp.arange(env.size)), axis=-1).reshape(-1, 2)
    states = jnp.tile(start, (len(cells), 1)).at[:, :2].set(cells)
    observations = jax.vmap(lambda state: env.observe(env.vector_to_state(jax.random.key(0), state)))(states)
    figure, (along, over) = plt.subplots(1, 2, figsize=(9, 3.6), dpi=120, layout="constrained")
    along.plot(value(episode.observations[0, : episode.lengths[0]]), color=RELABELLED, linewidth=2)
    along.set(title="along an episode", xlabel="step", ylabel="value", ylim=(0, 1.05))
    along.spines[["top", "right"]].set_visible(False)
    shown = over.imshow(value(observations).reshape(env.size, env.size), origin="upper")
    over.plot(*start[2:4], "s", color=DEMO, markersize=9, markeredgecolor="white", label="first object")
    over.plot(*start[:2], "o", color="white", markersize=8, label="agent, at the beginning")
    over.set(title="with the agent in each cell", xticks=[], yticks=[])
    over.legend(loc="lower left", fontsize=8, labelcolor="white", frameon=False)
    figure.colorbar(shown, label="value")
    figure.savefig(path, facecolor="white")
    plt.close(figure)


def crop(path: Path, box: tuple[int, int, int, int]) -> None:
    """Cuts a film to a part of its frames: left, top, right and bottom, pixels."""
    with Image.open(path) as film:
        frames = [each.convert("RGB").crop(box).quantize(64) for each in ImageSequence.Iterator(film)]
        durations = [each.info["duration"] for each in ImageSequence.Iterator(film)]
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=durations, loop=0)


def epsilon_filter(path: Path) -> None:
    """What the filter keeps of one demonstration of the arm."""
    with tempfile.TemporaryDirectory() as folder:
        demos = str(Path(folder) / "demos.hdf5")
        cli.main(["demos", "record", "--env", "FixedParameterizedReach", "--demos", "1", "--out", demos])
        cli.main(["demos", "plot", demos, "--epsilon-steps", "20", "--to", str(path)])


def cable_expert(path: Path) -> None:
    """The stages of the expert of the cable tasks, in C MuJoCo, as thesis figure 4.4 has them."""
    env = make("CableInsertion", backend="mujoco")
    demonstration = jax.tree.map(lambda leaf: np.asarray(leaf[0]), record_demonstrations(env, num_demos=1, seed=0))
    seen = demonstration.observations[: demonstration.lengths + 1]
    far = np.linalg.norm(seen[:, 18:24].reshape(-1, 2, 3), axis=2)  # from each hand to its head, m
    held, to_bottom = (seen[:, 27:29] > 0.5).all(axis=1), np.linalg.norm(seen[:, 24:27], axis=1)
    moments = {
        "1  to a place before the grip, with a shaky hand": np.argmax(far.max(axis=1) < 0.15),
        "2  straight to the grip": np.argmax(far.min(axis=1) < 0.02),
        "3, 4  close the fingers, wait for the other arm": np.argmax(held),
        "5  to the meeting, with shaky hands": np.argmax(held) + np.argmax(to_bottom[held] < 0.2),
        "6  align the plug before the mouth": np.argmax(held & (to_bottom < 0.045)),
        "7  push it in": demonstration.lengths,
    }
    figure, axes = plt.subplots(2, 3, figsize=(12, 7.6), dpi=110)
    for axis, (title, step) in zip(axes.flat, moments.items(), strict=True):
        state = env.vector_to_state(jax.random.key(0), demonstration.states[step])
        axis.imshow(cable_viewer.frame(env, state))
        axis.set_title(title, fontsize=11, color=INK, loc="left")
        axis.axis("off")
    figure.subplots_adjust(0.0, 0.0, 1.0, 0.96, 0.02, 0.06)
    figure.savefig(path, facecolor="white", pil_kwargs={"optimize": True})
    plt.close(figure)


if __name__ == "__main__":
    main()
