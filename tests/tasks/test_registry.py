"""A task of the user's own: registered, trained, saved and found again; and what is refused."""

import dataclasses
import sys
from pathlib import Path
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image
from toy_env import Corridor

import hindrl_jax as hindrl
from hindrl_jax import cli
from hindrl_jax.base.errors import UserError
from hindrl_jax.cli.train_options import parse_train
from hindrl_jax.envs import FixedGridPickAndPlace
from hindrl_jax.runs.reader import draw_episodes
from hindrl_jax.runs.spec import read_spec
from hindrl_jax.runs.writer import RunWriter
from hindrl_jax.tasks.presets import preset
from hindrl_jax.tasks.registry import TASKS, full_name, make, register, task

EXAMPLES = Path(__file__).parent.parent.parent / "examples"


@pytest.fixture
def forget(monkeypatch):
    """Makes as if the example had not been imported yet in this process; does so at the end, too. Its folder is the working directory."""
    monkeypatch.chdir(EXAMPLES)

    def forget():
        TASKS.pop("TwoRooms", None)
        sys.modules.pop("two_rooms", None)

    forget()
    yield forget
    forget()


def test_the_robot_of_the_tutorial(monkeypatch, tmp_path, capsys):
    """docs/tutorial.md follows examples/planar_arm.py; its training is too long for here."""
    monkeypatch.chdir(EXAMPLES)
    file = tmp_path / "arm.hdf5"
    try:
        cli.main(["demos", "record", "--env", "planar_arm:PlanarArm", "--demos", "1", "--out", str(file)])
        cli.main(["demos", "render", str(file)])
        assert file.with_suffix(".gif").stat().st_size > 0
        assert parse_train(["--demos", str(file)])[0].env == make("planar_arm:PlanarArm")  # the file says which task
        env = make("planar_arm:PlanarArm")
        goal = env.task_goal()
        solved = sys.modules["planar_arm"].ArmState(key=jax.random.key(0), joints=goal[2:4], pressed=jnp.array(True), step=jnp.array(3))
        np.testing.assert_allclose(env.achieved_goal(env.observe(solved)), goal, atol=1e-5)
        _, timestep = env.step(solved, jnp.zeros(2))
        assert timestep.terminated
        assert timestep.reward == 1
    finally:
        TASKS.pop("PlanarArm", None)
        sys.modules.pop("planar_arm", None)


def test_task_of_ones_own_by_the_commands(forget, tmp_path, capsys):
    """What is written down is found again by a process that has not imported the task. A whole run is in the notebook on own tasks."""
    file = tmp_path / "demos.hdf5"
    cli.main(["demos", "record", "--env", "two_rooms:TwoRooms", "--demos", "3", "--noise", "0.3", "--out", str(file)])
    forget()
    cli.main(["demos", "info", str(file), "--epsilon-steps", "3"])
    assert "two_rooms:TwoRooms(horizon=60" in capsys.readouterr().out
    forget()
    arguments = ["--env", "two_rooms:TwoRooms", "--preset", "original", "--gate-width", "0.2", "--demos", str(file)]
    spec, _ = parse_train(arguments)
    RunWriter(tmp_path / "run", spec, overwrite=False).start()
    forget()
    found = read_spec(tmp_path / "run")
    assert (full_name(found.env), found.env.gate_width) == ("two_rooms:TwoRooms", 0.2)
    assert found.config == spec.config == preset("hindrl", "original", env="FixedGridPickAndPlace")
    with pytest.raises(SystemExit):
        cli.main(["demos", "render", str(file)])
    assert "TwoRooms has no viewer to draw it" in capsys.readouterr().err


def test_demonstrated_actions_beyond_the_bounds_are_recorded_as_the_environment_takes_them(forget):
    env = make("two_rooms:TwoRooms")
    noisy = dataclasses.replace(task("TwoRooms").expert(), noise=2.0)
    demonstration = jax.tree.map(np.asarray, hindrl.record_demonstrations(env, 1, expert=noisy))
    actions = demonstration.actions[0, : demonstration.lengths[0]]
    assert np.abs(actions).max() == 1.0
    moved = np.diff(demonstration.observations[0, : demonstration.lengths[0] + 1, :2], axis=0)
    inside = (moved != 0).all(axis=1) & (demonstration.observations[0, 1 : demonstration.lengths[0] + 1, :2] % 1 != 0).all(axis=1)
    np.testing.assert_allclose(moved[inside], 0.05 * actions[inside], atol=1e-6)


def test_viewer_may_be_an_object_or_the_name_of_a_module(forget, tmp_path):
    class Viewer:
        @staticmethod
        def save_png(env, state, path):
            Image.new("RGB", (round(100 * float(state.gate)), 5)).save(path)

    env = make("two_rooms:TwoRooms")
    register(type(env), viewer=Viewer)
    draw_episodes(tmp_path / "state.png", env, [np.array([[0.1, 0.2, 0.3, 0.0], [0.1, 0.2, 0.7, 1.0]], np.float32)])
    with Image.open(tmp_path / "state.png") as picture:
        assert picture.size == (70, 5)


def test_the_states_of_a_film_are_unpacked_together(forget, tmp_path, monkeypatch):
    """One by one, each would be compiled anew in tasks that map over something: 70 s for a film of the cables."""
    drawn, calls = [], []

    class Viewer:
        @staticmethod
        def animation(env, states, *, captions):
            drawn.extend(states)
            return [np.zeros((4, 4, 3), np.uint8) for _ in states], [0.1 for _ in states]

    env = make("two_rooms:TwoRooms")
    unpack = type(env).vector_to_state
    monkeypatch.setattr(type(env), "vector_to_state", lambda *given: calls.append(1) or unpack(*given))
    register(type(env), viewer=Viewer)
    vectors = np.array([[0.1 * step, 0.2, 0.3, 0.0] for step in range(6)], np.float32)
    draw_episodes(tmp_path / "film.gif", env, [vectors[:2], vectors[2:]])
    assert len(calls) == 1
    np.testing.assert_array_equal([env.state_to_vector(state) for state in drawn], vectors)
    assert all(isinstance(leaf, np.ndarray | np.generic) for leaf in jax.tree.leaves(drawn) if not jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key))


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("two_rooms:Nope", "unknown environment 'Nope': two_rooms registers TwoRooms, by the `name` of the class; choose that"),
        ("json:Nope", "unknown environment 'Nope', not even by 'json', which is to call hindrl_jax.register"),
        ("no_such_module:Nope", "there is no module 'no_such_module': start the command in the folder where it is"),
        ("FixedGridPickAndPlac", "did you mean 'FixedGridPickAndPlace'?"),
        ("Nope", "or MODULE:NAME for a task of your own"),
    ],
)
def test_unknown_names_are_refused(forget, name, message):
    with pytest.raises(UserError, match=message.replace("?", r"\?")):
        make(name)


def test_module_that_fails_to_import_says_where(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mistaken_task.py").write_text("import no_such_package\n")
    with pytest.raises(ModuleNotFoundError, match="no_such_package"):
        make("mistaken_task:Maze")


@dataclasses.dataclass(frozen=True)
class Nameless(Corridor):
    """Its name is a field."""

    name: str = "Nameless"


@dataclasses.dataclass(frozen=True)
class Empty:
    name: ClassVar[str] = "Empty"
    horizon: int = 3


@dataclasses.dataclass(frozen=True)
class Taken(Empty):
    name: ClassVar[str] = "GridPickAndPlace"


@dataclasses.dataclass(frozen=True)
class Demanding:
    size: int
    name: ClassVar[str] = "Demanding"


@dataclasses.dataclass(frozen=True)
class Half(FixedGridPickAndPlace):
    name: ClassVar[str] = "Half"

    def relabel_observations(self, key, observations, subgoals):
        return observations, jnp.zeros(len(observations) - 1, bool)


class Plain:
    name = "Plain"


@pytest.mark.parametrize(
    ("environment", "message"),
    [
        (Nameless, 'needs a name that is no field: write name: ClassVar\\[str\\] = "Nameless"'),
        (Empty, "Empty lacks observation_dim, goal_dim"),
        (Taken, "is the name of one of this project's own tasks"),
        (Demanding, "Demanding has no default for size"),
        (Half, "Half has one of relabel_observations and num_subgoals: give it both or neither, see .*RelabelsObservations"),
        (Plain, "must be a class with @dataclasses.dataclass"),
        (Empty(), "must be a class with"),
    ],
)
def test_unusable_environments_are_refused(environment, message):
    before = dict(TASKS)
    with pytest.raises(UserError, match=message):
        register(environment)
    assert before == TASKS


def test_task_without_an_expert_says_so(forget):
    env = make("two_rooms:TwoRooms")
    register(type(env))
    with pytest.raises(UserError, match="no expert is known for TwoRooms: give one"):
        hindrl.record_demonstrations(env, 1)
