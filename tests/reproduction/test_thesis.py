"""The thesis's experiments as tables: which cells each artifact has, what they are trained with, and how long that is said to take."""

import dataclasses
from pathlib import Path
from typing import get_args

import pytest

from hindrl_jax.reproduction.claims import CLAIMS, settings_of_claims, settings_to_run
from hindrl_jax.reproduction.measures import MEASURES, MeasureName
from hindrl_jax.reproduction.scales import COMPILATION, RECIPE_NAMES, SCALES, Recipe, ScaleName, cells_of, seconds_of, spec_of
from hindrl_jax.reproduction.thesis import ARTIFACTS, TASKS, Setting, settings_of
from hindrl_jax.reproduction.thesis_pictures import PANELS
from hindrl_jax.tasks.presets import preset

ALL = tuple(ARTIFACTS)


@pytest.mark.parametrize(
    ("name", "number"),
    [
        ("table-5.1", 12),  # 4 numbers of demonstrations, 3 algorithms
        ("table-5.2", 9),
        ("table-5.3", 12),
        ("figure-5.1", 4),
        ("figure-5.2", 2),
        ("figure-5.3", 2),
        ("figure-5.4", 2),
        ("figure-5.5", 2),
        ("figure-5.6", 2),
        ("figure-5.7", 1),
        ("section-5.3", 6),
    ],
)
def test_the_settings_of_each_artifact(name, number):
    assert len(settings_of((name,))) == number


def test_artifacts_share_settings():
    # 33 of the three tables, Smooth HinDRL on reach, and three weights of two algorithms there; figures add nothing else.
    assert len(settings_of(ALL)) == 33 + 1 + 6
    assert set(settings_of(ALL)) >= settings_of_claims()
    tasks = [setting.task for setting in settings_of(ALL)]
    assert tasks == sorted(tasks, key=list(TASKS).index)  # so that the demonstrations of a task are recorded once


def test_the_published_figures_stand_beside_the_right_settings():
    published = {setting: figure for artifact in ARTIFACTS.values() for setting, figure in artifact.published}
    assert published[Setting("random-250", "bc")] == "75%"
    assert published[Setting("random-50", "hindrl")] == "4%"
    assert published[Setting("fixed-2", "bc")] == "5%"
    assert published[Setting("reach-100", "bc")] == "23%"
    assert published[Setting("reach-1", "hindrl")] == "100%"
    assert published[Setting("reach-1", "tqcfd", 0.1)] == "does not learn"


def test_names_are_those_of_tables():
    assert {name for artifact in ARTIFACTS.values() for name in artifact.panels} <= {*PANELS, "steps_to_100"}
    assert [claim.letter for claim in CLAIMS] == list("abcdefgh")
    assert set(MEASURES) == set(get_args(MeasureName))
    assert set(SCALES) == set(get_args(ScaleName))
    assert set(RECIPE_NAMES) == set(get_args(Recipe))


def test_settings_that_come_to_the_same_run_share_its_directory():
    plain, without = Setting("reach-1", "hindrl"), Setting("reach-1", "hindrl", 0.0)
    cells = cells_of(Path("out"), (plain, without), recipe="thesis", scale="laptop")  # which has no cloning loss on reach
    assert cells[plain] == cells[without]
    assert cells[plain].path == Path("out/cells/laptop/thesis/reach-1/hindrl")
    cells = cells_of(Path("out"), (plain, without), recipe="default", scale="laptop")
    assert cells[plain].spec.config.agent.bc_weight > 0.0
    assert cells[without].path == Path("out/cells/laptop/default/reach-1/hindrl-bc-0")
    assert cells[without].spec.config.agent.bc_weight == 0.0


@pytest.mark.parametrize("recipe", get_args(Recipe))
@pytest.mark.parametrize("scale", SCALES)
def test_every_cell_has_a_directory_of_its_own_run(recipe, scale):
    cells = cells_of(Path("out"), settings_of(ALL), recipe=recipe, scale=scale)
    # one of the weights of section 5.3 is that of the recipe, so those two settings, of both algorithms, are other cells, too
    assert len({cell.path for cell in cells.values()}) == len({(cell.path, cell.spec) for cell in cells.values()}) == 38


def test_full_is_the_appendix_unchanged():
    setting = Setting("reach-10", "hindrl")
    assert spec_of(setting, recipe="thesis", scale="full").config == preset("hindrl", "thesis", env="FixedParameterizedReach")


def test_laptop_changes_batches_and_steps_of_the_thesis_alone():
    spec = spec_of(Setting("reach-1", "hindrl"), recipe="original", scale="laptop")
    whole = preset("hindrl", "original", env="FixedParameterizedReach")
    batch = dataclasses.replace(whole.batch, batch_size=512)
    assert spec.config == dataclasses.replace(whole, steps=200_000, eval_every=10_000, batch=batch)
    assert spec.seeds == (5_000, 5_001, 5_002, 5_003)
    assert spec_of(Setting("fixed-1", "hindrl"), recipe="default", scale="laptop").config == dataclasses.replace(
        preset("hindrl"), imitation_steps=0, practice_rounds=0, network_resets=False
    )
    assert len(spec_of(Setting("fixed-1", "hindrl"), recipe="default", scale="laptop").seeds) == 32
    assert len(spec_of(Setting("reach-1", "hindrl"), recipe="default", scale="laptop").seeds) == 8


@pytest.mark.parametrize("scale", ["short", "laptop"])
def test_only_those_cells_of_the_thesis_run_that_a_claim_needs(scale):
    assert len(settings_to_run(ALL, recipe="default", scale=scale)) == 40
    assert set(settings_to_run(ALL, recipe="original", scale=scale)) == settings_of_claims()


def test_laptop_runs_those_cells_of_the_thesis_that_a_claim_needs():
    assert settings_to_run(("table-5.3",), recipe="default", scale="laptop") == settings_of(("table-5.3",))
    assert settings_to_run(("table-5.3",), recipe="thesis", scale="laptop") == [
        Setting("reach-100", "bc"),
        Setting("reach-1", "tqcfd"),
        Setting("reach-1", "hindrl"),
    ]
    assert settings_to_run(("table-5.3",), recipe="thesis", scale="full") == settings_of(("table-5.3",))


def test_the_original_has_its_own_rules():
    fixed = {recipe: spec_of(Setting("fixed-1", "hindrl"), recipe=recipe, scale="quick").env for recipe in get_args(Recipe)}
    assert [fixed[recipe].strict_order for recipe in ("default", "thesis", "original")] == [True, True, False]
    assert spec_of(Setting("reach-1", "hindrl"), recipe="original", scale="quick").env.orientation == "axis_angle"


def test_seconds_by_hand():
    spec = spec_of(Setting("fixed-1", "hindrl"), recipe="thesis", scale="laptop")
    # 200,000 gradient steps of 1 + 512 * 0.011 = 6.632 ms: 1326.4 s for each seed. Four seeds on two cores: two after the other.
    assert seconds_of(spec, cores=2) == pytest.approx(COMPILATION + 2 * 1326.4)
    assert seconds_of(spec, cores=8) == pytest.approx(COMPILATION + 1326.4)
    # Ours: one gradient step for four environment steps, of 1 + 256 * 0.011 = 3.816 ms. 16,000 steps: 4,000 of them, 15.264 s for each seed.
    assert seconds_of(spec_of(Setting("fixed-1", "hindrl"), recipe="default", scale="quick"), cores=1) == pytest.approx(COMPILATION + 2 * 15.264)
    # Cloning: 1,000 gradient steps of a fifth of 3.816 ms.
    assert seconds_of(spec_of(Setting("fixed-1", "bc"), recipe="default", scale="quick"), cores=2) == pytest.approx(COMPILATION + 0.7632)


def test_seconds_of_runs_that_hold_their_actions():
    # Of the arm's horizon of 300 a demonstration takes about 270: held for 4 steps, it has 67 decisions. 50,000 of these are 200,000 steps.
    setting = Setting("reach-1", "hindrl")
    assert seconds_of(spec_of(setting, recipe="default", scale="full", num_seeds=1), cores=1) == pytest.approx(COMPILATION + 50_000 * 3.816e-3)


def test_everything_quick_is_done_within_twenty_minutes_on_two_cores():
    for recipe in get_args(Recipe):
        cells = {cell.path: cell for cell in cells_of(Path("out"), settings_of(ALL), recipe=recipe, scale="quick").values()}
        assert sum(seconds_of(cell.spec, cores=2) for cell in cells.values()) <= 20 * 60
