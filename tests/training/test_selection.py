"""Which policies of a run are kept, which of them is returned, and what ends a run."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny
from toy_env import Corridor, corridor_demonstrations

import hindrl_jax as hindrl
from hindrl_jax.core.imitation import NOISES, NUM_STARTS, Attempts
from hindrl_jax.core.rollout import Evaluation
from hindrl_jax.runs.checkpoints import Checkpoints
from hindrl_jax.training.evaluating import Diverged
from hindrl_jax.training.imitating import PATIENCE, _after_a_round, _best_of, _not_yet, _worth
from hindrl_jax.training.selection import CHOICE_ROUNDS, NUM_KEPT, Moment, Trial, better, choose, keep, nothing_kept

NOBODY = np.zeros(1, bool)


def policies(*names):
    """Parameters of S actors, each of which is a number that it is known by."""
    return {"name": np.array(names, np.float32)}


def evaluation(success, length=10.0):
    """Of one run: 10 episodes."""
    return Evaluation(success=np.arange(10)[None] < round(10 * success), length=np.full((1, 10), length))


def trial(t, success, length=10.0):
    """Of one run: the policy that is named t, with noise t / 100."""
    return Trial(policies(t), np.array([t / 100]), evaluation(success, length))


def kept_of(*outcomes, confirmed=()):
    """One run, whose t-th policy, from 1, is named t and evaluated at step 100 t."""
    kept = nothing_kept(policies(0.0))
    for t, (success, length) in enumerate(outcomes, start=1):
        kept = keep(kept, trial(t, success, length), np.array([t in confirmed]), Moment(100 * t, 10 * t, float(t)))
    return kept


def names(kept):
    """Of what is kept, in order of time."""
    return sorted(kept.actor["name"][kept.success >= 0.0].tolist())


def test_each_run_is_judged_by_what_its_policy_does_better():
    """With its mean actions, of equals, too."""
    mean, sampled = (
        jax.tree.map(lambda *of_runs: np.concatenate(of_runs), *map(evaluation, *outcomes))
        for outcomes in (
            ((0.5, 0.8, 0.6), (1.0, 2.0, 3.0)),
            ((0.7, 0.3, 0.6), (4.0, 5.0, 6.0)),
        )
    )
    noise, chosen = better(mean, sampled)
    assert noise.tolist() == [1.0, 0.0, 0.0]
    assert chosen.success.mean(axis=1).tolist() == [0.7, 0.8, 0.6]
    assert chosen.length.mean(axis=1).tolist() == [4.0, 2.0, 3.0]


def test_the_worst_is_replaced_by_what_is_as_good():
    outcomes = [(0.5, 10.0), (0.2, 10.0), (0.8, 10.0), (0.6, 10.0)]
    assert len(outcomes) == NUM_KEPT
    assert names(kept_of(*outcomes)) == [1, 2, 3, 4]
    assert names(kept_of(*outcomes, (0.1, 5.0))) == [1, 2, 3, 4]
    kept = kept_of(*outcomes, (0.3, 12.0))
    assert names(kept) == [1, 3, 4, 5]
    (newest,) = np.flatnonzero(kept.actor["name"][0] == 5)
    assert (kept.success[0, newest], kept.length[0, newest], kept.env_steps[0, newest]) == (0.3, 12.0, 500)
    assert kept.noise[0, newest] == 0.05
    assert (kept.updates[0, newest], kept.seconds[0, newest]) == (50, 5.0)
    assert names(kept_of(*outcomes, (0.3, 12.0), (0.9, 12.0))) == [1, 3, 4, 6]


def test_of_equal_policies_those_with_shorter_episodes_are_kept_and_then_the_newer():
    outcomes = [(0.5, 10.0), (0.5, 12.0), (0.5, 11.0), (0.5, 9.0)]
    assert names(kept_of(*outcomes, (0.5, 11.5))) == [1, 3, 4, 5]
    assert names(kept_of(*outcomes, (0.5, 12.5))) == [1, 2, 3, 4]
    assert names(kept_of(*outcomes, (0.5, 12.0))) == [1, 3, 4, 5]


def test_a_confirmed_policy_is_kept_always_and_ends_the_changes_of_its_run():
    outcomes = [(0.9, 10.0)] * 4
    kept = kept_of(*outcomes, (0.8, 99.0), confirmed=(5,))
    assert kept.actor["name"][0, kept.confirmed[0]] == 5
    assert kept.all_confirmed
    assert not kept_of(*outcomes).all_confirmed
    later = keep(kept, trial(6, 1.0), np.array([True]), Moment(600, 60, 6.0))
    jax.tree.map(np.testing.assert_array_equal, later, kept)


def test_runs_are_kept_apart():
    kept = nothing_kept(policies(0.0, 0.0))
    both = jax.tree.map(lambda a, b: np.concatenate([a, b]), evaluation(0.3), evaluation(0.7))
    kept = keep(kept, Trial(policies(1, 2), np.zeros(2), both), np.array([False, True]), Moment(1, 1, 1.0))
    assert kept.confirmed.tolist() == [-1, 0]
    assert not kept.all_confirmed
    kept = keep(kept, Trial(policies(3, 4), np.zeros(2), both), np.array([False, False]), Moment(2, 2, 2.0))
    assert sorted(kept.actor["name"][0].tolist()) == [0, 0, 1, 3]
    assert sorted(kept.actor["name"][1].tolist()) == [0, 0, 0, 2]


class Player:
    """Plays with policies of which the success and the length are known, by their names; later rounds may have others."""

    def __init__(self, *rounds):
        self.rounds, self.played = rounds, []

    def __call__(self, actor, noise):
        (name,) = actor["name"].tolist()
        assert noise.tolist() == [0.0 if name == 9 else name / 100]  # those that it was evaluated with, and of the last policy the mean actions
        outcomes = self.rounds[min(self.played.count(name), len(self.rounds) - 1)]
        self.played.append(name)
        return evaluation(*outcomes[name])


NOW = Moment(1000, 100, 10.0)
KEPT = [(0.9, 10.0), (0.8, 10.0)]


@pytest.mark.parametrize(
    ("fresh", "chosen", "steps"),
    [
        ({0: (1.0, 1.0), 1: (0.5, 10.0), 2: (0.6, 10.0), 9: (0.4, 10.0)}, 2, 200),  # not the one whose evaluation was best
        ({0: (1.0, 1.0), 1: (0.5, 10.0), 2: (0.6, 10.0), 9: (0.7, 10.0)}, 9, 1000),  # the last
        ({0: (1.0, 1.0), 1: (0.6, 9.0), 2: (0.6, 10.0), 9: (0.6, 11.0)}, 1, 100),  # the quickest of equals
        ({0: (1.0, 1.0), 1: (0.6, 1.0), 2: (0.7, 999.0), 9: (0.6, 1.0)}, 2, 200),  # no number of steps outweighs an episode
    ],
)
def test_the_best_in_fresh_episodes_is_returned(fresh, chosen, steps):
    """Slots without a policy, which hold zeros, would be best, and are not played."""
    player = Player(fresh)
    returned, last = choose(kept_of(*KEPT), policies(9), NOW, player)
    assert 0.0 not in player.played
    assert returned.actor["name"].tolist() == [chosen]
    assert returned.noise.tolist() == [0.0 if chosen == 9 else chosen / 100]
    assert (returned.env_steps.tolist(), returned.updates.tolist(), returned.seconds.tolist()) == ([steps], [steps // 10], [steps / 100])
    assert (returned.success.tolist(), returned.length.tolist()) == ([fresh[chosen][0]], [fresh[chosen][1]])
    assert last.success.mean() == fresh[9][0]


def test_what_is_reported_comes_from_other_episodes_than_the_choice():
    lucky = {0: (0.0, 1.0), 1: (1.0, 10.0), 2: (0.6, 10.0), 9: (0.5, 10.0)}
    later = {1: (0.3, 20.0), 9: (0.4, 10.0)}
    player = Player(*[lucky] * CHOICE_ROUNDS, later)
    returned, last = choose(kept_of(*KEPT), policies(9), NOW, player)
    assert returned.actor["name"].tolist() == [1]
    assert (returned.success.tolist(), returned.length.tolist(), last.success.mean()) == ([0.3], [20.0], 0.4)


def test_what_is_confirmed_is_returned_without_a_choice():
    fresh = {5: (0.2, 10.0), 9: (0.9, 10.0)}
    player = Player(fresh)
    returned, _ = choose(kept_of(*[(0.9, 10.0)] * 4, (0.8, 99.0), confirmed=(5,)), policies(9), NOW, player)
    assert returned.actor["name"].tolist() == [5]
    assert returned.env_steps.tolist() == [500]
    assert player.played == [5, 9]


def test_beside_runs_that_choose_a_confirmed_policy_is_returned():
    kept = jax.tree.map(lambda a, b: np.concatenate([a, b]), kept_of(*KEPT), kept_of(*KEPT, confirmed=(1,)))

    def play(actor, noise):
        return Evaluation(success=np.arange(10) < actor["name"][:, None], length=np.ones((2, 10)))

    returned, _ = choose(kept, policies(9, 9), NOW, play)
    assert returned.actor["name"].tolist() == [9, 1]
    assert returned.env_steps.tolist() == [1000, 100]


def test_slots_that_only_other_runs_have_filled_are_not_chosen():
    """They hold zeros, which would be best."""
    kept = jax.tree.map(lambda a, b: np.concatenate([a, b]), kept_of(*KEPT[:1]), kept_of(*KEPT))

    def play(actor, noise):
        return Evaluation(success=np.arange(10) < np.where(actor["name"] == 0, 10, actor["name"])[:, None], length=np.ones((2, 10)))

    returned, _ = choose(kept, policies(0.5, 0.5), NOW, play)
    assert returned.actor["name"].tolist() == [1, 2]


# --------------------------------------------------------------------------------------------------------------------------- in a whole run

ENV = Corridor()
"""It is solved by hardly any effort: a policy that knows nothing walks at half the speed, and arrives."""
CONFIG = dataclasses.replace(tiny.CONFIG, steps=400, learning_starts=20, eval_every=20, action_hold=1, stop_at=0.9)
SEEDS = (3, 4)


class Killed(Exception):
    pass


def fit(config=CONFIG, demonstrations=None, **choices):
    return hindrl.fit(ENV, corridor_demonstrations() if demonstrations is None else demonstrations, config, seeds=SEEDS, **choices)


@pytest.fixture(scope="module")
def solved():
    return fit()


def test_a_run_ends_when_all_its_policies_are_confirmed(solved):
    assert solved.kept.all_confirmed
    assert solved.env_steps < CONFIG.steps
    assert solved.env_steps == solved.rows[-1].env_steps
    for index in range(len(SEEDS)):
        confirming = [row for row in solved.rows[index :: len(SEEDS)] if row.env_steps == solved.returned.env_steps[index]]
        (success,) = [max(row.success, row.metrics["evaluation/sampled_success"]) for row in confirming]
        assert success >= 0.9
        slot = solved.kept.confirmed[index]
        for found, kept in zip(jax.tree.leaves(solved.returned.actor), jax.tree.leaves(solved.kept.actor), strict=True):
            np.testing.assert_array_equal(found[index], kept[index, slot])
    assert max(solved.returned.env_steps) == solved.env_steps
    assert (solved.returned.success > 0.5).all()


def test_evaluations_are_counted(solved):
    """Those along the run, both ways, those that confirm, and two of the returned and the last policies: episodes of 2 to 5 steps."""
    evaluations = 2 * (len(solved.rows) // len(SEEDS))
    fewest, most = evaluations * CONFIG.eval_episodes + 300, evaluations * (CONFIG.eval_episodes + 100) + 200
    assert (solved.evaluation_steps >= 2 * fewest).all()
    assert (solved.evaluation_steps <= 5 * most).all()
    assert [summary.evaluation_steps for summary in solved.summaries()] == solved.evaluation_steps.tolist()


def test_a_run_goes_on_where_it_was_stopped_with_the_policies_that_were_kept(solved, tmp_path):
    """Killed when its policies were confirmed, before the end."""
    checkpoints = Checkpoints(tmp_path, seconds=0)

    def report(result):
        checkpoints.save_when_due(result)
        if result.kept.all_confirmed:
            raise Killed

    with pytest.raises(Killed):
        fit(report=report)
    resumed = fit(restore=Checkpoints(tmp_path).restore)
    assert resumed.env_steps == solved.env_steps
    for name in ("kept", "returned"):
        found, expected = (getattr(result, name).replace(seconds=0.0) for result in (resumed, solved))
        jax.tree.map(np.testing.assert_array_equal, found, expected)
    np.testing.assert_array_equal(resumed.evaluation_steps, solved.evaluation_steps)


def easily_imitated():
    """Two demonstrations, at a speed that solves the task and with starts of its own."""
    walking = corridor_demonstrations((1.25, 1.25))
    return walking.replace(observations=walking.observations.at[:, :, 0].set(jnp.array([[0.2], [0.8]])))


CLONING = dataclasses.replace(CONFIG, imitation_steps=300, agent=dataclasses.replace(CONFIG.agent, learning_rate=1e-2))


@pytest.fixture(scope="module")
def cloned():
    """A run that ends when one policy of each seed is good enough, which the clone is at once."""
    return fit(CLONING, easily_imitated())


def test_a_clone_that_is_good_enough_is_returned_and_nothing_else_is_tried(cloned):
    assert (cloned.cloned_success == 1.0).all()
    assert (cloned.env_steps, cloned.updates, cloned.returned.env_steps.tolist()) == (0, 0, [0, 0])
    assert [(row.env_steps, row.success) for row in cloned.rows] == [(0, 1.0), (0, 1.0)]  # the clone's evaluation, and none of what learnt nothing
    assert cloned.returned.actor["imitates"].tolist() == [1, 1]
    assert (cloned.returned.success == 1.0).all()
    summary = cloned.summaries()[0]
    assert (summary.cloned_success, summary.returned_env_steps, summary.returned_updates) == (1.0, 0, 0)
    assert summary.final_success == 1.0  # one that knows nothing, which learning would have begun with, arrives, too


def test_practice_makes_a_clone_faster_than_its_demonstrations():
    """Both walk slowly, the corridor's end can be reached sooner, and nothing is learnt but by practice."""
    demonstrations = corridor_demonstrations((0.65, 0.65))
    walking = demonstrations.replace(observations=demonstrations.observations.at[:, :, 0].set(jnp.array([[0.2], [0.8]])))
    said = []
    config = dataclasses.replace(CLONING, stop_at=None, practice_rounds=4, steps=80)
    result = fit(config, walking, report=lambda result: said.append((result.env_steps, result.practised_success, result.practice_steps.copy())))
    before = fit(dataclasses.replace(config, practice_rounds=0), walking)
    assert before.practised_success is None
    assert before.practice_steps.tolist() == [0, 0]
    assert (result.cloned_success == before.cloned_success).all()
    assert (result.practised_success == 1.0).all()
    lengths = [kept.length[kept.actor["imitates"] == 1].min() for kept in (before.kept, result.kept)]
    assert lengths[1] < lengths[0] - 0.5
    fewest = NUM_STARTS * len(NOISES)  # of a round, one step for each attempt
    assert ((result.practice_steps > 2 * fewest) & (result.practice_steps <= 4 * fewest * 5)).all()
    rounds = [steps for done, _, steps in said if not done]
    assert all((later >= sooner).all() for sooner, later in itertools.pairwise(rounds))
    assert [summary.practice_steps for summary in result.summaries()] == result.practice_steps.tolist()
    kept_at = np.where(result.kept.actor["imitates"] == 1, result.kept.env_steps, 0)  # the steps of its practice until then
    assert (kept_at.max(axis=1) > 0).all()
    assert (kept_at.max(axis=1) <= result.practice_steps).all()
    # Learning goes on as it would have without.
    for found, expected in zip(jax.tree.leaves(result.state.agent.actor), jax.tree.leaves(before.state.agent.actor), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-5)


def test_the_steps_of_practice_are_those_after_which_a_run_was_solved():
    """The demonstrations are just fast enough, and their clones not quite, until they have practised."""
    walking = corridor_demonstrations((0.601, 0.601))
    walking = walking.replace(observations=walking.observations.at[:, :, 0].set(jnp.array([[0.2], [0.8]])))
    result = fit(dataclasses.replace(CLONING, practice_rounds=8), walking)
    assert (result.cloned_success < 0.9).any()
    assert result.kept.all_confirmed
    assert result.env_steps == 0
    assert result.practice_steps.max() > 0
    at = result.kept.env_steps[np.arange(2), result.kept.confirmed]
    assert result.returned.env_steps.tolist() == at.tolist()
    assert at.max() == result.practice_steps.max()
    assert (result.practice_steps == at).all()  # a run that is over practises no more
    assert [row.env_steps for row in result.rows] == result.practice_steps.tolist()


def test_what_practises_is_the_best_of_the_first_clones():
    """Of equals the later one, which imitated for longer."""
    clones = [policies(part, part + 0.5, part) for part in (1, 2, 3)]
    best = _best_of(clones, [np.array([0.9, 0.5, 0.0]), np.array([0.9, 0.2, 0.4]), np.array([0.1, 0.5, 0.2])])
    assert best["name"].tolist() == [2.0, 3.5, 2.0]


def test_practice_ends_for_each_seed_with_the_second_round_running_that_is_no_better():
    """The first gets better at last, the second and third no more after the first round, 2% and less being no gain; nothing begins anew."""
    practising = _not_yet(3)
    assert PATIENCE == 2
    for rounds, (worth, goes_on) in enumerate(
        [
            ([0.2, 0.50, 0.0], [True, True, True]),
            ([0.1, 0.51, 0.0], [True, True, False]),
            ([0.3, 0.50, 0.9], [True, False, False]),
            ([0.2, 0.90, 0.9], [True, False, False]),
            ([0.3, 0.90, 0.9], [False, False, False]),
        ],
        start=1,
    ):
        practising = _after_a_round(practising, np.array(worth))
        assert practising.rounds == rounds
        assert practising.goes_on.tolist() == goes_on
    assert practising.score.tolist() == [0.3, 0.9, 0.9]


def test_what_attempts_are_worth():
    attempts = Attempts(solved=np.array([[[True, False], [True, True]]]), length=np.full((1, 2, 2), 5), delay=np.array([[[0, 3], [1, 2]]]))
    configs = [dataclasses.replace(CONFIG, batch=dataclasses.replace(CONFIG.batch, gamma=0.5))]
    np.testing.assert_allclose(_worth(attempts, configs), [(1.0 + 0.0 + 0.5 + 0.25) / 4])


def test_practice_ends_where_it_is_of_no_use_and_where_a_report_says_so():
    """No clone of demonstrations that stand still ever arrives."""
    standing = easily_imitated()
    standing = standing.replace(actions=jnp.full_like(standing.actions, -1.0))
    config = dataclasses.replace(CLONING, stop_at=None, practice_rounds=3, steps=80)
    result = fit(config, standing)
    assert (result.cloned_success.tolist(), result.practised_success, result.practice_steps.tolist()) == ([0.0, 0.0], None, [0, 0])
    ended = fit(config, easily_imitated(), report=lambda result: result.cloned_success is not None)
    assert (ended.env_steps, ended.practised_success) == (0, None)
    assert (ended.returned.success == 1.0).all()


PRACTISING = dataclasses.replace(CLONING, stop_at=None, practice_rounds=3, steps=80)


@pytest.fixture(scope="module")
def practised():
    """A run whose clones practise, before it learns for a while."""
    return fit(PRACTISING, easily_imitated())


def test_each_clone_practises_for_as_long_as_that_is_of_use_to_it(practised):
    """The first seed's clone stands still and does not begin; the other practises as it does beside one like itself."""
    walking, alike = easily_imitated(), practised
    mixed = fit(PRACTISING, [walking.replace(actions=jnp.full_like(walking.actions, -1.0)), walking])
    assert mixed.cloned_success.tolist() == mixed.practised_success.tolist() == [0.0, 1.0]
    assert mixed.practice_steps[0] == 0
    assert mixed.practice_steps[1] == alike.practice_steps[1] > 0
    summary = mixed.summaries()[0]
    assert (summary.practised_success, summary.practice_steps) == (None, 0)
    clones_kept = (mixed.kept.actor["imitates"][0] == 1) & (mixed.kept.success[0] >= 0.0)
    assert mixed.kept.env_steps[0][clones_kept].max(initial=0) == 0
    assert mixed.kept.success[1].tolist() == alike.kept.success[1].tolist()


def test_practice_that_was_killed_goes_on_after_its_last_round(practised, tmp_path):
    checkpoints = Checkpoints(tmp_path, seconds=0)

    def report(result):
        checkpoints.save_when_due(result)
        if result.practising is not None and result.practising.rounds == 2:
            raise Killed

    with pytest.raises(Killed):
        fit(PRACTISING, easily_imitated(), report=report)
    assert [path.name for path in tmp_path.iterdir()] == ["practice-2"]
    said = []
    assert practised.practising is None
    resumed = fit(PRACTISING, easily_imitated(), restore=Checkpoints(tmp_path).restore, report=lambda result: said.append(result.practice_steps))
    assert (said[0] > 0).all()
    for name in ("cloned_success", "practised_success", "practice_steps", "evaluation_steps", "final_success"):
        np.testing.assert_array_equal(getattr(resumed, name), getattr(practised, name), err_msg=name)
    for name in ("kept", "returned"):
        found, expected = (getattr(result, name).replace(seconds=0.0) for result in (resumed, practised))
        jax.tree.map(np.testing.assert_array_equal, found, expected)
    jax.tree.map(np.testing.assert_array_equal, resumed.state.agent, practised.state.agent)


def test_a_clone_that_is_not_finite_ends_the_run():
    demonstrations = easily_imitated()
    spoilt = demonstrations.replace(actions=demonstrations.actions.at[0, 0].set(np.nan))
    with pytest.raises(Diverged, match="the clone of the demonstrations of seed 3 is not finite"):
        fit(CLONING, spoilt)


def test_learning_goes_the_same_way_with_and_without_a_clone(tmp_path):
    """Nothing is confirmed, and the run is killed and resumed before its first evaluation."""
    config = dataclasses.replace(CLONING, stop_at=None, steps=80)
    without = fit(dataclasses.replace(config, imitation_steps=0), easily_imitated())
    uninterrupted = fit(config, easily_imitated())
    checkpoints = Checkpoints(tmp_path, seconds=0)

    def report(result):
        checkpoints.save_when_due(result)
        if result.updates:
            raise Killed

    with pytest.raises(Killed):
        fit(config, easily_imitated(), report=report)
    resumed = fit(config, easily_imitated(), restore=Checkpoints(tmp_path).restore)
    assert (resumed.cloned_success == 1.0).all()
    assert without.cloned_success is None
    assert resumed.evaluation_steps.tolist() == uninterrupted.evaluation_steps.tolist()
    assert (resumed.evaluation_steps > without.evaluation_steps).all()
    for found, expected in zip(jax.tree.leaves(resumed.state.agent.actor), jax.tree.leaves(without.state.agent.actor), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-5)
    kept = resumed.kept.actor["imitates"] * (resumed.kept.env_steps == 0) * (resumed.kept.success == 1.0)
    assert (kept.sum(axis=1) >= 1).all()


def test_a_report_that_returns_true_ends_the_run_which_can_be_saved(tmp_path):
    demonstrations = hindrl.record_demonstrations(tiny.ENV, 2)
    first, second, config = [], [], tiny.CONFIG
    result = hindrl.fit(tiny.ENV, demonstrations, config, report=lambda result: bool(first.append(result.env_steps)) or len(first) == 3)
    # Reports: before anything happened, after two chunks, and at the end.
    assert len(first) == 4
    assert result.env_steps == first[2] < 60
    assert len(result.rows) == 1  # it was not evaluated before
    assert result.returned is not None
    (saved,) = hindrl.save_run(tmp_path, result)["seeds"]
    assert (saved["returned_env_steps"], saved["final_success"]) == (result.env_steps, result.final_success[0])
    run, last = hindrl.load_run(tmp_path), hindrl.load_run(tmp_path, last=True)
    assert run.spec.config == dataclasses.replace(config, action_hold=1)  # which was chosen
    for policy, actor in ((run.policies, result.returned.actor), (last.policies, result.state.agent.average_actor)):
        jax.tree.map(np.testing.assert_array_equal, policy.actor, actor)
    # What is merely not empty, such as what several reporters return together, ends nothing.
    hindrl.fit(tiny.ENV, demonstrations, config, report=lambda result: (second.append(result.env_steps), None))
    assert second[-1] == 60
