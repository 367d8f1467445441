"""Ablations: the levers, the statistics by hand, what is trained and what is kept, and the tables that come of it."""

import csv
import dataclasses
import json
import re
import shutil
from pathlib import Path
from typing import get_args

import jax
import numpy as np
import pytest
from commands import refusal
from PIL import Image
from tiny import CONFIG

from hindrl_jax import cli
from hindrl_jax.base.errors import UserError
from hindrl_jax.core import train as training
from hindrl_jax.plotting.statistics import Interval, bootstrap
from hindrl_jax.reproduction import ablation
from hindrl_jax.reproduction.ablation import (
    ABLATION_TASKS,
    BASELINE,
    LEVERS,
    AblationTask,
    Lever,
    apply,
    outcomes_of,
    settings_of,
    success_along,
)
from hindrl_jax.runs.spec import read_spec
from hindrl_jax.tasks.presets import preset
from hindrl_jax.tasks.registry import make
from hindrl_jax.training.recording import record_demonstrations

TINY = dataclasses.replace(CONFIG, steps=80, eval_episodes=100)
SMALL = AblationTask("FixedGridPickAndPlace", (("num_objects", 1), ("size", 4), ("random_box_size", 1), ("horizon", 20)), 1)

LEVER = next(lever for lever in LEVERS if lever.name == "n-step-1")


@pytest.fixture(scope="module", autouse=True)
def tiny():
    """One small task and a small recipe in place of the real ones."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ablation, "ABLATION_TASKS", {"small": SMALL})
        patch.setattr(ablation, "preset", lambda algo, *, env: TINY)
        yield


def command(out, *arguments):
    return ["reproduce", "ablation", "--out", str(out), "--seeds", "2", "--seed", "7", *arguments]


def run(out, *arguments):
    cli.main(command(out, *arguments))


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A finished ablation of one lever, which was interrupted in between."""
    out = tmp_path_factory.mktemp("ablation") / "out"
    _, interrupted = settings_of(out, tasks=["small"], levers=[LEVER], seeds=(7, 8))
    interrupted.path.mkdir(parents=True)
    (interrupted.path / "config.json").write_text(json.dumps(interrupted.spec.to_json()))
    (interrupted.path / "metrics.csv").write_text("half a line")
    run(out, "--levers", LEVER.name)
    return out


def contents(out: Path) -> dict[str, tuple[int, bytes]]:
    return {str(file.relative_to(out)): (file.stat().st_mtime_ns, file.read_bytes()) for file in out.glob("*/*/*")}


# --------------------------------------------------------------------------------------------------------------------------------- levers


@pytest.mark.parametrize("lever", LEVERS, ids=lambda lever: lever.name)
def test_every_lever_changes_each_of_its_fields_and_nothing_else(lever):
    config = preset("hindrl", env="FixedGridPickAndPlace")
    before, after = (dataclasses.asdict(each) for each in (config, apply(config, lever)))
    for part in ("batch", "goal", "agent"):
        before |= {f"{part}.{name}": value for name, value in before.pop(part).items()}
        after |= {f"{part}.{name}": value for name, value in after.pop(part).items()}
    changed = {name for name in before if before[name] != after[name]}
    asked = {name for name, _ in lever.changes}
    # joint_union names its share, which is the default's, for the reader
    assert changed
    assert changed == asked - {"batch.union_sampling_ratio"}


@pytest.fixture(scope="module")
def demonstration():
    env = make("FixedGridPickAndPlace")
    return env, record_demonstrations(env, 1)


@pytest.mark.parametrize("lever", LEVERS, ids=lambda lever: lever.name)
def test_every_lever_makes_a_program(lever, demonstration):
    """Traced, not compiled: what the config's own checks let pass, the training must not refuse."""
    env, episodes = demonstration
    config = apply(preset("hindrl", env=env), lever)

    def start_and_learn(key):
        guidance = training.guidance(episodes, env, config)
        return training.learn(training.init(key, guidance, env, config), guidance, env=env, config=config, num_iterations=1)

    state, metrics = jax.eval_shape(start_and_learn, jax.random.key(0))
    assert (state.env_steps.shape, metrics["critic/loss"].shape) == ((), ())


def test_levers_have_names_for_directories_of_their_own():
    names = [lever.name for lever in (BASELINE, *LEVERS)]
    assert len(set(names)) == len(names)
    assert all(re.fullmatch(r"[a-z0-9]+([-.][a-z0-9]+)*", name) for name in names)
    assert all(lever.summary and "|" not in lever.summary for lever in LEVERS)
    assert all(lever.group in get_args(ablation.Group) and lever.group != BASELINE.group for lever in LEVERS)


def test_the_summaries_speak_of_the_recipe_as_it_is():
    """They say "in place of 5" and the like by hand, so whoever changes the recipe must look at them."""
    recipe = preset("hindrl")
    batch, agent = recipe.batch, recipe.agent
    assert (batch.n_step, batch.gamma, batch.max_demo_ratio, batch.relabelled_per_original, batch.batch_size) == (5, 0.98, 0.25, 0.25, 256)
    assert (agent.num_critics, agent.target_update_rate, agent.bc_weight, agent.initial_alpha) == (2, 0.02, 0.01, 0.002)
    assert (agent.target_entropy, agent.final_target_entropy, agent.actor_average_rate) == (-1.0, -10.0, 0.002)
    assert (recipe.num_envs, recipe.updates_per_iteration) == (16, 2)


def test_changes_are_made_at_once_and_may_depend_on_the_config():
    config = dataclasses.replace(TINY, steps=1_000)
    lever = Lever("both", "targets", "", (("algo", "tqcfd"), ("batch.relabelled_per_original", 0.0), ("batch.reach_zero", ablation.half_of_the_run)))
    changed = apply(config, lever)  # one after the other they would be refused
    assert (changed.algo, changed.batch.relabelled_per_original, changed.batch.reach_zero) == ("tqcfd", 0.0, 500)
    with pytest.raises(UserError, match="n_step = 0"):
        apply(config, Lever("bad", "targets", "", (("batch.n_step", 0),)))


def test_the_tasks_are_those_of_the_grid():
    assert [(name, task.title()) for name, task in ABLATION_TASKS.items()] == [
        ("fixed-1", "FixedGridPickAndPlace, num_objects 2, 1 demonstration"),
        ("fixed-5", "FixedGridPickAndPlace, num_objects 2, 5 demonstrations"),
        ("random-50", "GridPickAndPlace, num_objects 2, 50 demonstrations"),
    ]


# ----------------------------------------------------------------------------------------------------------------------------- statistics


def test_bootstrap_by_hand():
    # Two values are drawn as 0 0, 0 1, 1 0 or 1 1: the means 0, 0.5 and 1 with chances 1/4, 1/2 and 1/4, so both tails of 2.5% lie in the ends.
    assert bootstrap([0.0, 1.0]) == Interval(estimate=0.5, low=0.0, high=1.0)
    assert bootstrap([0.3, 0.3, 0.3]) == Interval(estimate=pytest.approx(0.3), low=pytest.approx(0.3), high=pytest.approx(0.3))
    # Of three values the median of the draw is the smallest if it is drawn twice or thrice: 3 (1/9)(2/3) + 1/27 = 7/27; likewise the largest.
    assert bootstrap([1.0, 2.0, np.inf], np.median) == Interval(estimate=2.0, low=1.0, high=np.inf)
    # Of 40 values, the chance that one that is drawn is the infinite one is 1/40; that half of the draw are is nothing.
    assert bootstrap([*np.full(39, 5.0), np.inf], np.median) == Interval(estimate=5.0, low=5.0, high=5.0)
    assert bootstrap([np.inf, np.inf], np.median) == Interval(estimate=np.inf, low=np.inf, high=np.inf)
    with pytest.raises(ValueError, match="at least 2"):
        bootstrap([1.0])


def test_bootstrap_of_many_values_agrees_with_the_normal_distribution():
    values = np.random.default_rng(1).normal(loc=3.0, size=400)
    half_width = 1.96 * values.std() / 20.0  # 20 is the root of 400
    found = bootstrap(values)
    np.testing.assert_allclose((found.low, found.high), (values.mean() - half_width, values.mean() + half_width), atol=0.05 * half_width)


def test_an_interval_excludes_what_lies_outside_it():
    assert not Interval(1.0, 0.0, 2.0).excludes(0.0)
    assert Interval(1.0, 0.1, 2.0).excludes(0.0)
    assert Interval(-1.0, -2.0, -0.1).excludes(0.0)


def test_success_along_a_run_is_the_area_under_its_evaluations():
    # From 0 to 100 it rises to 0.5: area 25. From 100 to 200 it stays: 50. From 200 to 250 it rises to 1: 37.5. In all 112.5 of 250.
    assert success_along([100, 200, 250], [0.5, 0.5, 1.0]) == pytest.approx(112.5 / 250)


# ------------------------------------------------------------------------------------------------------------------------------- outcomes


def write_run(setting, *, curves, final, seconds):
    """The files of a finished run, with success `curves` (S, 2) at 40 and 80 steps."""
    setting.path.mkdir(parents=True)
    (setting.path / "config.json").write_text(json.dumps(setting.spec.to_json()))
    rows = ["seed,env_steps,updates,success"]
    for index, env_steps in enumerate((40, 80)):
        rows += [f"{seed},{env_steps},{env_steps // 4},{curve[index]}" for seed, curve in zip(setting.spec.seeds, curves, strict=True)]
    (setting.path / "metrics.csv").write_text("\n".join(rows))
    first = [next((40 * (i + 1) for i, success in enumerate(curve) if success >= 0.95), None) for curve in curves]
    seeds = [{"env_steps_to_95": steps, "final_success": value} for steps, value in zip(first, final, strict=True)]
    (setting.path / "summary.json").write_text(json.dumps({"seeds": seeds, "train_seconds": seconds}))


@pytest.fixture
def by_hand(tmp_path):
    """Settings whose outcomes can be worked out: the baseline, one worse, one better, one that is not there."""
    settings = settings_of(tmp_path, tasks=["small"], levers=LEVERS[:3], seeds=(7, 8))
    write_run(settings[0], curves=[(0.4, 0.8), (0.0, 0.96)], final=[0.9, 1.0], seconds=10.0)
    write_run(settings[1], curves=[(0.0, 0.4), (0.0, 0.16)], final=[0.5, 0.5], seconds=30.0)
    write_run(settings[2], curves=[(0.96, 1.0), (1.0, 1.0)], final=[1.0, 1.0], seconds=5.0)
    return settings


def test_outcomes_by_hand(by_hand):
    baseline, worse, better = outcomes_of(by_hand)
    # Along the run, seed by seed: (0.5 * 0.4 * 40 + 0.5 * (0.4 + 0.8) * 40) / 80 = 0.4, and 0.5 * 0.96 * 40 / 80 = 0.24.
    assert baseline.mean_success == Interval(pytest.approx(0.32), pytest.approx(0.24), pytest.approx(0.4))
    assert baseline.difference == Interval(0.0, 0.0, 0.0)
    assert baseline.steps_to_95 == Interval(np.inf, 80.0, np.inf)
    assert (baseline.seeds_reaching_95, baseline.seconds_per_seed, baseline.relative_cost, baseline.verdict()) == (1, 5.0, 1.0, "open")
    # 0.1 and 0.04, so 0.3 and 0.2 less than the baseline's.
    assert worse.difference == Interval(pytest.approx(-0.25), pytest.approx(-0.3), pytest.approx(-0.2))
    assert worse.final_success == Interval(0.5, 0.5, 0.5)
    assert (worse.seeds_reaching_95, worse.relative_cost, worse.verdict()) == (0, 3.0, "worse")
    assert better.steps_to_95 == Interval(40.0, 40.0, 40.0)
    assert (better.seeds_reaching_95, better.relative_cost, better.verdict()) == (2, 0.5, "better")


def test_levers_are_compared_within_the_first_life_of_the_agent():
    recipe = preset("hindrl", env="FixedGridPickAndPlace")
    assert ablation._first_life(recipe) == dataclasses.replace(recipe, steps=80_000, agent_resets=())
    assert ablation._first_life(TINY) == TINY


def test_without_its_baseline_a_task_has_no_outcomes(by_hand):
    (by_hand[0].path / "summary.json").unlink()
    assert outcomes_of(by_hand) == []


def test_damaged_runs_are_refused(by_hand):
    (by_hand[1].path / "metrics.csv").write_text("seed,env_steps\n7,40\n")
    with pytest.raises(UserError, match="is damaged"):
        outcomes_of(by_hand)


def test_tables_by_hand(by_hand, tmp_path):
    ablation.write_tables(tmp_path, outcomes_of(by_hand))
    rows = list(csv.DictReader((tmp_path / "ablation.csv").read_text().splitlines()))
    assert [(row["task"], row["lever"], row["seeds_reaching_95"], row["median_steps_to_95"]) for row in rows] == [
        ("small", "default", "1", "inf"),
        ("small", LEVERS[0].name, "0", "inf"),
        ("small", LEVERS[1].name, "2", "40"),
    ]
    assert [rows[1][name] for name in ("difference", "difference_low", "difference_high", "relative_cost")] == ["-0.25", "-0.3", "-0.2", "3"]
    text = (tmp_path / "ablation.md").read_text()
    assert "2 seeds from 7, 80 environment steps each" in text
    assert "## small: FixedGridPickAndPlace, num_objects 1" in text
    assert "| default | 1/2 | >0k [0k, >0k] | 95.0 [90.0, 100.0] | 32.0 [24.0, 40.0] |  | 5.0 | 1.00 |" in text
    assert f"| {LEVERS[0].name} | 0/2 | >0k [>0k, >0k] | 50.0 [50.0, 50.0] | 7.0 [4.0, 10.0] | **-25.0 [-30.0, -20.0]** | 15.0 | 3.00 |" in text
    assert text.index("| default |") < text.index(f"| *{LEVERS[0].group}* |") < text.index(f"| {LEVERS[0].name} |")
    assert f"| {LEVERS[0].name} | {LEVERS[0].summary} |" in text
    with Image.open(tmp_path / "ablation.png") as picture:
        assert min(picture.size) > 200


@pytest.mark.parametrize(("steps", "said"), [(62_400.0, "62k"), (np.inf, ">300k")])
def test_steps_that_were_not_enough_are_said_to_be_more(steps, said):
    assert ablation.thousands(steps, 300_000) == said


# ---------------------------------------------------------------------------------------------------------------------------- the command


def test_an_ablation_leaves_runs_and_tables(finished):
    assert sorted(str(file.relative_to(finished)) for file in finished.glob("*")) == ["ablation.csv", "ablation.md", "ablation.png", "small"]
    assert sorted(file.name for file in finished.glob("small/*")) == ["default", "n-step-1"]
    baseline, lever = (read_spec(finished / "small" / name) for name in ("default", "n-step-1"))
    assert (baseline.config, lever.config) == (TINY, dataclasses.replace(TINY, batch=dataclasses.replace(TINY.batch, n_step=1)))
    assert (baseline.seeds, baseline.demos, baseline.env.horizon) == ((7, 8), "1", 20)
    for name in ("default", "n-step-1"):
        evaluations = list(csv.DictReader((finished / "small" / name / "metrics.csv").read_text().splitlines()))
        assert [(row["seed"], row["env_steps"]) for row in evaluations] == [("7", "60"), ("8", "60"), ("7", "80"), ("8", "80")]
    rows = list(csv.DictReader((finished / "ablation.csv").read_text().splitlines()))
    assert [row["lever"] for row in rows] == ["default", "n-step-1"]
    assert all(np.isfinite(float(row[name])) for row in rows for name in ("difference_low", "seconds_per_seed", "relative_cost"))


def test_what_is_finished_is_not_trained_again(finished, capsys):
    before = contents(finished)
    text = (finished / "ablation.md").read_text()
    (finished / "ablation.md").unlink()
    capsys.readouterr()
    run(finished, "--levers", "n-step-1")
    assert "0 settings to train, 2 seeds from 7, 2 finished before" in capsys.readouterr().out
    assert contents(finished) == before
    assert (finished / "ablation.md").read_text() == text


def test_what_is_interrupted_is_trained_again_and_said_in_a_line(finished, tmp_path, capsys, monkeypatch):
    """Training is replaced by a copy of what was trained."""
    shutil.copytree(finished / "small" / "default", tmp_path / "small" / "default")
    shutil.copytree(finished / "small" / "n-step-1", tmp_path / "small" / "n-step-1")
    summary = (tmp_path / "small" / "n-step-1" / "summary.json").rename(tmp_path / "kept.json")
    monkeypatch.setattr(ablation, "train", lambda setting, *, report: summary.rename(setting.path / "summary.json"))
    capsys.readouterr()
    run(tmp_path, "--levers", "n-step-1")
    printed = capsys.readouterr().out
    assert "1 setting to train, 2 seeds from 7, 1 finished before" in printed
    assert len(re.findall(r"^small +n-step-1 +\d of 2 reach 95%, median .* final +\d+% +[\d.]+ s$", printed, re.MULTILINE)) == 1


def test_runs_of_other_options_are_refused_and_replaced_only_on_request(finished, capsys):
    before = contents(finished)
    assert "default holds a run of other options (config.steps)" in refusal(capsys, *command(finished, "--levers", "n-step-3", "--steps", "100"))
    assert "default holds a run of other options (seeds)" in refusal(capsys, *command(finished, "--levers", "n-step-3", "--seed", "9"))
    assert contents(finished) == before
    others = settings_of(finished, tasks=["small"], levers=[], seeds=(7, 9))
    ablation.check_can_train(others, overwrite=True)
    assert not ablation.is_finished(others[0])


def test_files_that_are_not_ours_are_not_replaced(tmp_path, capsys):
    (tmp_path / "small" / "default").mkdir(parents=True)
    (tmp_path / "small" / "default" / "summary.json").write_text("mine")
    assert "summary.json" in refusal(capsys, *command(tmp_path))
    assert (tmp_path / "small" / "default" / "summary.json").read_text() == "mine"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--levers", "n-stp-1"], "--levers n-stp-1 is not known (did you mean 'n-step-1'?)"),
        (["--tasks", "smal"], "--tasks smal is not known (did you mean 'small'?)"),
        (["--seeds", "1"], "an interval needs at least 2"),
        (["--seed", "-1"], "--seed -1 is not usable"),
        (["--steps", "0"], "steps = 0"),
        (["--steps", "10"], "steps = 10 ends within"),
        (["--step", "100"], "did you mean --steps?"),
    ],
)
def test_bad_input_is_one_line_and_writes_nothing(arguments, message, tmp_path, capsys):
    assert message in refusal(capsys, *command(tmp_path / "out", *arguments))
    assert not (tmp_path / "out").exists()


def test_the_list_shows_every_lever_and_trains_nothing(tmp_path, capsys):
    run(tmp_path / "out", "--list")
    printed = capsys.readouterr().out
    assert all(re.search(rf"^ *{re.escape(lever.name)} +{lever.group} ", printed, re.MULTILINE) for lever in LEVERS)
    assert not (tmp_path / "out").exists()


def test_the_group_of_commands_has_a_usage(capsys):
    cli.main(["reproduce", "--help"])
    assert "hindrl reproduce ablation" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        cli.main(["reproduce"])
    assert "'hindrl reproduce' needs a command: choose one of ablation" in capsys.readouterr().err
