"""Comparing runs: directories written by hand, so that every figure is known."""

import csv
import dataclasses
import json

import numpy as np
import pytest
from commands import refusal

import hindrl_jax as hindrl
from hindrl_jax import cli
from hindrl_jax.config import TrainConfig
from hindrl_jax.plotting.statistics import Interval
from hindrl_jax.reporting.compare import changes, compare, find_runs, read_runs, remarks, write_csv
from hindrl_jax.runs.spec import RunSpec

ENV = hindrl.make("FixedGridPickAndPlace")


def write(path, success, *, final=None, seeds=(0, 1), algo="hindrl", env=ENV, every=100, **fields):
    """A run whose seeds have these rows of success, an evaluation every so many steps and seconds / 10; finished if there is a final success."""
    path.mkdir(parents=True)
    spec = RunSpec(env=env, config=TrainConfig(algo=algo, steps=1_000, **fields), demos="1", seeds=tuple(seeds))
    (path / "config.json").write_text(json.dumps(spec.to_json()))
    lines = ["seed,env_steps,updates,seconds,success,episode_length"]
    for number, evaluation in enumerate(zip(*success, strict=True), 1):
        at = every * number
        lines += [f"{seed},{0 if algo == 'bc' else at},{at * 2},{at / 10},{value},9" for seed, value in zip(seeds, evaluation, strict=True)]
    (path / "metrics.csv").write_text("\n".join(lines) + "\n")
    if final is not None:
        (path / "summary.json").write_text(
            json.dumps({"seeds": [{"seed": s, "returned_success": f} for s, f in zip(seeds, final, strict=True)], "train_seconds": 1.0})
        )
    return path


@pytest.fixture
def first(tmp_path):
    return write(tmp_path / "first", [[0.5, 0.95, 0.9], [0.0, 0.5, 0.96]], final=[0.9, 1.0])


def test_figures_of_a_run(first):
    (one,) = compare(read_runs([first]))
    # seed 0 reaches 95% at its second evaluation and seed 1 at its third: 200 and 300 steps, 20 and 30 s
    assert (one.seeds_reaching_95, one.steps_to_95, one.seconds_to_95) == (2, 250.0, 25.0)
    assert one.returned_success == Interval(estimate=pytest.approx(0.95), low=0.9, high=1.0)
    assert one.difference is None


def test_a_seed_that_never_gets_there_counts_as_later_than_all(first, tmp_path):
    half = write(tmp_path / "half", [[0.5, 0.95], [0.0, 0.5]], final=[0.9, 1.0])
    most = write(tmp_path / "most", [[0.5, 0.95], [0.95, 0.5], [0.0, 0.0]], final=[0.9, 1.0, 0.0], seeds=(0, 1, 2))
    one, other = compare(read_runs([half, most]))
    assert (one.seeds_reaching_95, one.steps_to_95) == (1, np.inf)
    assert (other.seeds_reaching_95, other.steps_to_95) == (2, 200.0)


def test_differences_are_taken_seed_by_seed_where_the_seeds_are_the_same(first, tmp_path):
    # Each seed is 0.2 below its own result in the first run, whatever the order in which the seeds are listed.
    lower = write(tmp_path / "lower", [[0.0], [0.0]], final=[0.8, 0.7], seeds=(1, 0))
    others = write(tmp_path / "others", [[0.0], [0.0]], final=[0.8, 0.7], seeds=(1, 2))
    _, paired, unpaired = compare(read_runs([first, lower, others]))
    assert paired.paired
    assert paired.difference == Interval(estimate=pytest.approx(-0.2), low=pytest.approx(-0.2), high=pytest.approx(-0.2))
    assert not unpaired.paired
    # the largest and the smallest differences of resampled means, each in one of 16 draws: 0.8 - 0.9 and 0.7 - 1.0
    assert unpaired.difference == Interval(estimate=pytest.approx(-0.2), low=pytest.approx(-0.3), high=pytest.approx(-0.1))


def test_a_run_under_way_is_read_as_far_as_it_is_whole(first, tmp_path):
    path = write(tmp_path / "running", [[0.5, 0.25], [0.0, 0.75]])
    with (path / "metrics.csv").open("a") as file:
        file.write("0,300,600,30.0,1.0,9\n1,300,600,30.0,0.")  # the second seed's row is being written
    run = read_runs([path])[0]
    assert not run.finished
    assert run.env_steps.tolist() == [100, 200]
    assert run.returned_success.tolist() == [0.25, 0.75]
    assert "running is not finished: its success is that of the evaluation at 200 of 1,000 steps" in remarks(compare(read_runs([first, path])))


def test_bc_counts_gradient_steps(first, tmp_path):
    path = write(tmp_path / "bc", [[0.5, 0.95], [1.0, 0.5]], final=[0.5, 0.5], algo="bc")
    _, bc = compare(read_runs([first, path]))
    assert bc.steps_to_95 == 300.0  # 400 and 200 updates
    assert "bc takes no environment steps: its steps are gradient steps" in remarks([_, bc])


def test_clones_that_were_good_enough_count_the_steps_of_their_practice(first, tmp_path):
    """Each seed's own, and that they are clones is said: the methods were not compared."""
    clones = write(tmp_path / "clones", [[0.96], [1.0]], final=[0.95, 1.0])
    (clones / "metrics.csv").write_text("seed,env_steps,updates,seconds,success,episode_length\n0,60,0,7,0.96,9\n1,0,0,7,1,9\n")
    run, other = compare(read_runs([clones, first]))
    assert (run.seeds_reaching_95, run.steps_to_95, run.seconds_to_95) == (2, 30.0, 7.0)
    assert run.run.env_steps.tolist() == [60]
    said = "clones ended with clones, before its method learnt anything: to compare methods, train with --imitation-steps 0"
    assert said in remarks([run, other])
    assert said not in remarks([other])


def test_what_few_seeds_cannot_tell_is_said(first, tmp_path):
    alone = write(tmp_path / "alone", [[1.0]], final=[1.0], seeds=(0,))
    lacking, narrow = (
        "a single seed has no interval: train several, for example --seeds 8",
        "with fewer than 8 seeds the intervals are much too narrow",
    )
    for paths, expected in (([alone], [lacking]), ([first], [narrow]), ([first, alone], [lacking, narrow])):
        assert [line for line in remarks(compare(read_runs(paths))) if "interval" in line] == expected


def test_other_environments_and_other_settings_are_named(first, tmp_path):
    three = write(tmp_path / "three", [[0.0], [0.0]], env=dataclasses.replace(ENV, num_objects=3), num_envs=64)
    run, other = read_runs([first, three])
    assert changes(other, run) == {"num_objects": (3, 2), "num_envs": (64, run.spec.config.num_envs)}
    assert any(line.startswith("the runs are of different environments") for line in remarks(compare([run, other])))


def test_a_sweep_stands_for_its_runs_and_names_are_as_short_as_they_can_be(tmp_path):
    for name in ("one/a", "one/b", "two/a"):
        write(tmp_path / name, [[0.0]], seeds=(0,))
    (tmp_path / "one" / "sweep.csv").write_text("")
    paths = find_runs([tmp_path / "one", tmp_path / "two" / "a", tmp_path / "one" / "a"])
    assert [run.label for run in read_runs(paths)] == ["one/a", "one/b", "two/a"]
    assert [run.label for run in read_runs(paths[:2])] == ["a", "b"]


def test_the_command_prints_a_table_and_writes_what_it_is_asked_for(first, tmp_path, capsys):
    lower = write(tmp_path / "lower", [[0.0], [0.0]], final=[0.8, 0.7], seeds=(1, 0), num_envs=64)
    cloned = write(tmp_path / "bc", [[0.5, 0.95], [1.0, 0.5]], final=[0.5, 0.5], algo="bc")
    alone = write(tmp_path / "alone", [[0.25]], seeds=(7,))
    picture, table = tmp_path / "runs.png", tmp_path / "runs.csv"
    cli.main(["compare", *map(str, (first, lower, cloned, alone)), "--to", str(picture), "--csv", str(table)])
    printed = " ".join(capsys.readouterr().out.split())
    assert "first 95.0% [90, 100] 2 of 2 250 25.0 lower 75.0% [70, 80] 0 of 2 never never -20.0 [-20, -20]" in printed
    assert "bc 50.0% [50, 50] 2 of 2 300 updates 15.0 -45.0 [-50, -40] alone * 25.0% 0 of 1 never never ~ -70.0 lower:" in printed
    assert "lower: seeds 1 0 instead of 0 to 1, num_envs 64 instead of 8" in printed
    assert picture.read_bytes().startswith(b"\x89PNG")
    rows = list(csv.DictReader(table.read_text().splitlines()))
    assert [(row["run"], row["median_env_steps_to_95"], row["median_updates_to_95"], row["difference"], row["paired"]) for row in rows] == [
        ("first", "250", "", "", ""),
        ("lower", "inf", "", "-0.2", "True"),
        ("bc", "", "300", "-0.45", "True"),
        ("alone", "inf", "", "-0.7", "False"),
    ]


def test_what_cannot_be_compared_is_one_line(first, tmp_path, capsys):
    assert "give the directories of two or more runs" in refusal(capsys, "compare")
    assert "is not the directory of a run, nor of several" in refusal(capsys, "compare", first, tmp_path / "nowhere")
    assert "must end in .png" in refusal(capsys, "compare", first, "--to", tmp_path / "runs.pdf")
    assert "no folder" in refusal(capsys, "compare", first, "--csv", tmp_path / "nowhere" / "runs.csv")
    early = write(tmp_path / "early", [[], []])
    assert "no evaluation of all its seeds yet" in refusal(capsys, "compare", first, early)
    (early / "metrics.csv").unlink()
    assert "has no metrics.csv yet" in refusal(capsys, "compare", first, early)
    (early / "metrics.csv").write_text("seed,env_steps\n0,x\n")
    assert "is damaged" in refusal(capsys, "compare", first, early)
    with pytest.raises(hindrl.UserError, match="cannot write"):
        write_csv(compare(read_runs([first])), tmp_path)
