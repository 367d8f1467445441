"""`hindrl train`, `hindrl sweep`, and what reads a run back. In process; the one training run is tiny and shared by the tests that read it."""

import csv
import dataclasses
import json
import shlex
import shutil
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from commands import TINY, refusal
from toy_env import Corridor, corridor_demonstrations

import hindrl_jax as hindrl
from hindrl_jax import cli
from hindrl_jax.cli.running import _stop, _where_it_goes_on
from hindrl_jax.cli.train_options import parse_train
from hindrl_jax.cli.training import advice, said_of_clones, said_of_never
from hindrl_jax.runs.reader import load_run
from hindrl_jax.runs.shipped import shipped
from hindrl_jax.runs.spec import RunSpec
from hindrl_jax.tasks import registry
from hindrl_jax.tasks.presets import preset
from hindrl_jax.training.result import Row

SEED_FIELDS = {"seed", "final_success", "env_steps_to_95", "updates_to_95", "seconds_to_95", "episode_length", "evaluation_steps", "cloned_success"}
SEED_FIELDS |= {"practised_success", "practice_steps", "network_resets"}
SEED_FIELDS |= {f"returned_{what}" for what in ("success", "length", "noise", "env_steps", "updates", "seconds")}
TOTALS = {"updates_per_second", "env_steps_per_second", "compile_seconds", "train_seconds", "peak_memory_bytes"}


def test_run_directory_holds_what_it_promises(run):
    assert {file.name for file in run.iterdir()} == {
        "config.json",
        "metrics.csv",
        "summary.json",
        "parameters.npz",
        "curve.png",
        "episode.gif",
    }
    summary = json.loads((run / "summary.json").read_text())
    assert set(summary) == TOTALS | {"seeds"}
    assert [set(seed) for seed in summary["seeds"]] == [SEED_FIELDS] * 2
    assert [seed["seed"] for seed in summary["seeds"]] == [5, 6]
    assert all(seed["env_steps_to_95"] is None for seed in summary["seeds"])
    rows = list(csv.DictReader((run / "metrics.csv").read_text().splitlines()))
    # 200 random steps, then chunks of 4 steps (a tenth of eval_every, in steps of 2 environments): evaluations at 240 and 260 for 2 seeds
    assert [(row["seed"], row["env_steps"], row["updates"]) for row in rows] == [
        ("5", "240", "20"),
        ("6", "240", "20"),
        ("5", "260", "30"),
        ("6", "260", "30"),
    ]
    assert all(np.isfinite(float(value)) for row in rows for value in row.values())
    with np.load(run / "parameters.npz", allow_pickle=False) as archive:
        assert archive["policy/params/Dense_0/kernel"].shape == archive["last_policy/params/Dense_0/kernel"].shape == (2, 40, 8)


def advised(spec, *returned, out="runs/mine"):
    """What is said after a run whose seeds returned policies of this success."""
    return advice(spec, [{"returned_success": success} for success in returned], Path(out))


def test_a_run_that_solves_nothing_says_what_to_try():
    config = preset("hindrl")
    spec = RunSpec(env=hindrl.make("FixedGridPickAndPlace"), config=config, demos="1", seeds=(0,))
    lines = advised(spec, 0.0)
    assert [line.split(".")[0].strip() for line in lines[1:]] == ["1", "2", "3", "4", "5"]
    assert "hindrl demos info" in lines[1]
    assert "--steps 200000" in lines[3]
    assert "--demos 10" in lines[4]
    of_file = "\n".join(advised(dataclasses.replace(spec, demos="mine.hdf5", config=preset("bc")), 0.0))
    assert "hindrl demos info mine.hdf5" in of_file
    assert "--algo bc" not in of_file
    assert "--demo-reset-ratio" not in of_file


def test_a_run_that_solves_little_says_what_to_try():
    spec = RunSpec(env=hindrl.make("FixedGridPickAndPlace"), config=preset("hindrl"), demos="1", seeds=(0,))
    lines = advised(spec, 0.43, out="runs/a run")
    assert lines[0].startswith("43% of the episodes were solved")
    assert len(lines) == 2
    wanted = ["--steps 200000", "--seeds 4", "--demos 10", "hindrl render 'runs/a run' --episodes 5"]
    places = ["\n".join(lines).find(one) for one in wanted]
    assert -1 not in places
    assert places == sorted(places)
    assert "--demos 60" in advised(dataclasses.replace(spec, demos="30"), 0.43)[1]
    of_file = "\n".join(advised(dataclasses.replace(spec, demos="mine.hdf5", seeds=(0, 1)), 0.9, 0.2))
    assert of_file.startswith("55% ")
    assert "--demos" not in of_file
    assert "--seeds" not in of_file


def test_a_run_that_did_what_was_asked_for_is_left_alone():
    spec = RunSpec(env=hindrl.make("FixedGridPickAndPlace"), config=preset("hindrl"), demos="1", seeds=(0,))
    assert advised(spec, 0.79)
    assert not advised(spec, 0.8)
    assert not advised(spec, 1.0, 0.6)  # on average
    half = dataclasses.replace(spec, config=dataclasses.replace(spec.config, stop_at=0.5))
    assert not advised(half, 0.6)
    assert advised(half, 0.4)


def evaluation(seed, env_steps, mean, sampled):
    metrics = {} if sampled is None else {"evaluation/sampled_success": sampled}
    return Row(seed=seed, env_steps=env_steps, updates=1, seconds=1.0, success=mean, episode_length=9.0, metrics=metrics)


def test_a_clone_that_was_kept_is_called_one():
    learnt, clone = ({"seed": seed, "returned_updates": updates, "returned_env_steps": 8 * updates} for seed, updates in ((3, 500), (4, 0)))
    assert said_of_clones([learnt]) == []
    assert said_of_clones([clone]) == ["what was kept at step 0 is the clone of the demonstrations"]
    assert said_of_clones([learnt, clone]) == ["what was kept at step 0 of seed 4 is the clone of the demonstrations"]
    practised = said_of_clones([learnt, clone | {"returned_env_steps": 900}])
    assert practised == ["what was kept of seed 4 is the clone of the demonstrations, and its steps are those of its practice"]
    assert "of seeds 4, 5 is" in said_of_clones([learnt, clone, clone | {"seed": 5}])[0]


@pytest.mark.parametrize(
    ("rounds", "steps", "stopped", "goes_on"),
    [
        (None, 0, "stopped after 0 of 80 steps; no checkpoint", "there is no checkpoint yet: beginning again"),
        (0, 0, "stopped after 0 of 80 steps; no checkpoint", "there is no checkpoint yet: beginning again"),
        (1, 0, "stopped after 1 round of practice; no checkpoint", "going on after 1 round of practice"),
        (None, 40, "stopped after 40 of 80 steps; no checkpoint", "going on at step 40"),
    ],
)
def test_a_run_says_where_it_was_stopped_and_goes_on(rounds, steps, stopped, goes_on, capsys):
    practising = None if rounds is None else SimpleNamespace(rounds=rounds)
    result = SimpleNamespace(practising=practising, steps_done=steps, steps_unit="steps", config=SimpleNamespace(num_steps=80))
    assert _where_it_goes_on(result) == goes_on
    with pytest.raises(SystemExit):
        _stop(result, 2, None, None)
    assert stopped in capsys.readouterr().err


def test_never_is_explained_where_sampled_actions_solved_the_task():
    """Seeds: 0 reached 95% with mean actions, 1 with sampled ones only, 2 in fresh episodes only, 3 not at all."""
    shares = {0: ((0.5, 0.5), (0.95, 0.5)), 1: ((0.5, 0.95), (0.5, 1.0)), 2: ((0.9, 0.9), (0.9, 0.94)), 3: ((0.2, 0.2), (0.2, 0.2))}
    rows = [evaluation(seed, 1_000 * (n + 1), *shares[seed][n]) for n in range(2) for seed in shares]
    returned = {0: (1.0, 7), 1: (1.0, None), 2: (0.96, None), 3: (0.3, None)}
    seeds = [{"seed": seed, "returned_success": share, "updates_to_95": at, "returned_updates": 5} for seed, (share, at) in returned.items()]
    (line,) = said_of_never(seeds, rows)
    assert line.endswith("with mean actions only; with sampled actions 95% was reached: seed 1 at 1,000, seed 2 not")
    assert said_of_never([seeds[0], seeds[3]], rows) == []
    assert said_of_never([seeds[1] | {"returned_updates": 0}], rows) == []  # a clone, of which no evaluation along the run tells
    assert said_of_never(seeds[2:3], [evaluation(2, 0, 0.9, None)]) == []  # of bc, which plays no sampled actions


def test_config_runs_again_in_place_of_another_run_whose_checkpoints_are_not_read(run, tmp_path, monkeypatch):
    again = shutil.copytree(run, tmp_path / "again")
    left = again / "checkpoint" / "240"
    left.mkdir(parents=True)
    for name in ("config.json", "parameters.npz"):
        (again / name).write_text("of another run")

    def read(self, begun):
        raise AssertionError("a checkpoint of another run is read")

    monkeypatch.setattr("hindrl_jax.runs.checkpoints.Checkpoints.restore", read)
    cli.main(["train", "--config", str(run), "--overwrite", "--out", str(again)])
    assert not left.exists()
    assert (again / "config.json").read_text() == (run / "config.json").read_text()
    with np.load(run / "parameters.npz") as first, np.load(again / "parameters.npz") as second:
        for name in first.files:
            np.testing.assert_array_equal(first[name], second[name])


def test_other_flags_change_a_config(run):
    spec, _ = parse_train(["--config", str(run / "config.json"), "--learning-rate", "0.5", "--seeds", "1"])
    assert (spec.config.agent.learning_rate, spec.seeds, spec.config.batch.batch_size) == (0.5, (5,), 16)


def test_actions_are_held_as_the_config_says_which_notes_what_was_chosen(tmp_path, capsys, monkeypatch):
    """For all settings alike, by demonstrations of 126 steps: twice, so that 63 decisions remain."""
    monkeypatch.setattr(registry, "TASKS", dict(registry.TASKS))
    hindrl.register(Corridor)
    env, demos, out = Corridor(horizon=150, width=125.0), tmp_path / "demos.hdf5", tmp_path / "sweep"
    demonstrations = corridor_demonstrations((1.0,), env=env)
    hindrl.save_demonstrations(demos, demonstrations, env=env, env_args=dataclasses.asdict(env))
    where = ["--env", "Corridor", "--horizon", "150", "--width", "125", "--demos", str(demos)]
    sizes = shlex.split("--num-envs 2 --learning-starts 300 --steps 330 --eval-every 20 --eval-episodes 3 --updates-per-iteration 1")
    more = shlex.split("--batch-size 16 --net-arch 8 --buffer-size 2000 --seed 3 --seeds 2 --imitation-steps 0")
    cli.main(["sweep", "--over", "learning_rate=1e-3,2e-3", "--out", str(out), *where, *sizes, *more])
    printed = " ".join(capsys.readouterr().out.split())
    assert "each action is held for 2 steps, so a demonstration of 126 steps takes 63 decisions" in printed
    for rate in ("0.001", "0.002"):
        folder = out / f"learning_rate={rate}"
        saved = json.loads((folder / "config.json").read_text())["config"]
        assert (saved["action_hold"], saved["agent"]["learning_rate"]) == (2, float(rate))
        run = load_run(folder)
        assert run.spec.config.action_hold == 2
        played = run.play(2, key=jax.random.key(0))
        pairs = np.asarray(played.actions).reshape(2, 75, 2, 2)
        within = np.arange(75)[None] < np.asarray(played.lengths)[:, None] // 2
        np.testing.assert_array_equal(pairs[within][:, 0], pairs[within][:, 1])
        assert all(row["episode_length"] % 2 == 0 for row in run.evaluate(episodes=1))  # the horizon is even
        rows = list(csv.DictReader((folder / "metrics.csv").read_text().splitlines()))
        assert [int(row["env_steps"]) for row in rows] == [320, 320, 332, 332]  # 75 decisions of 2 steps at random, then 4 steps an iteration


def test_sweep_leaves_a_run_for_each_setting(tmp_path, capsys):
    out = tmp_path / "sweep"
    cli.main(
        [
            "sweep",
            "--over",
            "learning-rate=1e-3,2e-3",
            "--over",
            "bc_weight=0.1",
            "--seeds",
            "2",
            "--seed",
            "5",
            "--tensorboard",
            "--out",
            str(out),
            *TINY,
        ]
    )
    printed = capsys.readouterr().out
    assert "2 seeds from 5, 2 settings" in printed
    folders = ["learning_rate=0.001,bc_weight=0.1", "learning_rate=0.002,bc_weight=0.1"]
    assert sorted(file.name for file in out.iterdir()) == [*folders, "sweep.csv", "sweep.json", "sweep.png"]
    rows = list(csv.DictReader((out / "sweep.csv").read_text().splitlines()))
    assert [[row[name] for name in ("learning_rate", "bc_weight", "seeds", "seeds_reaching_95", "median_steps_to_95")] for row in rows] == [
        ["0.001", "0.1", "2", "0", ""],
        ["0.002", "0.1", "2", "0", ""],
    ]
    for folder, rate in zip(folders, (1e-3, 2e-3), strict=True):
        run = load_run(out / folder)
        assert (run.spec.seeds, run.spec.config.agent.learning_rate, run.spec.config.agent.bc_weight) == ((5, 6), rate, 0.1)
        assert jax.tree.leaves(run.policies)[0].shape[0] == 2
        metrics = list(csv.DictReader((out / folder / "metrics.csv").read_text().splitlines()))
        assert [(row["seed"], row["env_steps"]) for row in metrics] == [("5", "240"), ("6", "240"), ("5", "260"), ("6", "260")]
        for name in ("seed_5", "seed_6", "mean"):
            (events,) = (out / folder / "tensorboard" / name).iterdir()
            assert b"evaluation/success" in events.read_bytes()
            assert b"final/success" in events.read_bytes()
    first, second = (np.load(out / folder / "parameters.npz")["policy/params/Dense_0/kernel"] for folder in folders)
    assert np.abs(first - second).max() > 0.0
    assert "already holds sweep.json, sweep.csv" in refusal(capsys, "sweep", "--over", "gamma=0.9,0.8", "--out", out, *TINY)
    assert "already holds config.json" in refusal(capsys, "sweep", "--over", "gamma=0.9,0.8", "--overwrite", "--out", out / folders[0], *TINY)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["sweep"], "--over is missing"),
        (["sweep", "--over", "batch_size=1,2"], "'batch_size' cannot be swept"),
        (["sweep", "--over", "gama=0.9"], "did you mean 'gamma'?"),
        (["sweep", "--over", "gamma"], "write for example --over gamma=0.1,0.2"),
        (["sweep", "--over", "gamma=0.9,x"], "write for example --over gamma=0.1,0.2"),
        (["sweep", "--over", "gamma=0.9,0.9"], "a value is listed twice"),
        (["sweep", "--over", "gamma=0.9,0.9000000001"], "a value is listed twice"),
        (["sweep", "--over", "epsilon_deviations=1,2", "--epsilon", "0.1"], "would change nothing: epsilon itself is given"),
        (["sweep", "--over", "union_sampling_ratio=0.1,0.2"], "would change nothing: only relabelling by joint_union"),
        (["sweep", "--algo", "bc", "--over", "gamma=0.1,0.2"], "would change nothing: behaviour cloning does not use it"),
        (["sweep", "--over", "gamma=0.9", "--over", "gamma=0.8"], "gamma is given twice"),
        (["sweep", "--over", "gamma=0.9,1.5"], "gamma = 1.5 is not usable"),
        (["train", "--host", "0"], "add --distributed"),
        (["train", "--distributed", "--host", "0"], "belong together"),
        (["train", "--distributed", "--coordinator", "first", "--num-hosts", "2", "--host", "0"], "write HOST:PORT"),
        (["train", "--distributed", "--coordinator", "first:1", "--num-hosts", "2", "--host", "2"], "--host 2 is not one of --num-hosts 2"),
    ],
)
def test_sweeps_and_hosts_that_make_no_sense_are_refused(arguments, message, tmp_path, capsys):
    out = tmp_path / "run"
    tiny = [] if "bc" in arguments else TINY
    assert message in refusal(capsys, *arguments, "--out", out, *tiny)
    assert not out.exists()


def test_a_place_inside_a_file_is_refused(tmp_path, capsys):
    file = tmp_path / "file"
    file.write_text("mine")
    assert "is a file" in refusal(capsys, "train", "--out", file / "run", *TINY)
    assert file.read_text() == "mine"


def test_eval_and_render_read_the_run_back(run, tmp_path, capsys):
    cli.main(["eval", str(run), "--episodes", "4", "--noise", "1"])
    assert "4 episodes per seed" in capsys.readouterr().out
    cli.main(["eval", str(run), "--episodes", "2", "--last"])
    assert "2 episodes per seed" in capsys.readouterr().out
    film = tmp_path / "film.gif"
    cli.main(["render", str(run), "--to", str(film), "--seed", "6"])
    assert film.read_bytes().startswith(b"GIF89a")
    capsys.readouterr()
    cli.main(["render", str(run), "--to", str(tmp_path / "film.mp4"), "--episodes", "2"])
    assert "0 of 2 episodes are solved" in capsys.readouterr().out
    assert (tmp_path / "film.mp4").read_bytes()[4:8] == b"ftyp"
    assert "too few" in refusal(capsys, "render", run, "--episodes", 0)
    assert "no seed 7" in refusal(capsys, "render", run, "--seed", 7, "--to", tmp_path / "other.gif")
    assert not (tmp_path / "other.gif").exists()
    assert "must end in .gif, .mp4 or .png" in refusal(capsys, "render", run, "--to", tmp_path / "film.avi")


def test_files_that_are_not_ours_are_not_replaced(tmp_path, capsys):
    (tmp_path / "summary.json").write_text("mine")
    assert "summary.json" in refusal(capsys, "train", "--out", tmp_path, *TINY)
    assert (tmp_path / "summary.json").read_text() == "mine"


def test_existing_run_is_refused_and_kept(run, capsys):
    before = {file.name: file.read_bytes() for file in run.iterdir()}
    assert "already holds a run" in refusal(capsys, "train", "--out", run, *TINY)
    # even with --overwrite, nothing is lost when the rest of the command is not usable
    refusal(capsys, "train", "--out", run, "--overwrite", "--demos", "missing.hdf5", *TINY)
    refusal(capsys, "train", "--out", run, "--overwrite", "--buffer-size", "100")
    assert {file.name: file.read_bytes() for file in run.iterdir()} == before


def test_policies_that_ship_are_listed_and_small(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    cli.main(["policies"])
    printed = capsys.readouterr().out
    assert {"FixedGridPickAndPlace", "FixedParameterizedReach"} <= set(shipped())
    for name, path in shipped().items():
        assert f" {name} " in printed
        assert sum(file.stat().st_size for file in path.iterdir()) < 1_500_000
        assert load_run(path).spec.env.name == name
    cli.main(["eval", "policy:FixedGridPickAndPlace", "--episodes", "20"])
    assert " 2      100.0%" in capsys.readouterr().out
    cli.main(["render", "policy:FixedGridPickAndPlace"])
    assert (tmp_path / "FixedGridPickAndPlace_episode_0_seed_2.gif").stat().st_size > 0
    assert "did you mean 'FixedParameterizedReach'?" in refusal(capsys, "render", "policy:ParameterizedReach")


@pytest.mark.slow
@pytest.mark.parametrize("name", shipped())
def test_policies_that_ship_solve_their_tasks(name):
    (outcome,) = load_run(shipped()[name]).evaluate(episodes=100)
    assert outcome["success"] >= 0.97
