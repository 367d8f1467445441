"""What changes along a run, by hand."""

import numpy as np
import pytest

from hindrl_jax.config import AgentConfig
from hindrl_jax.core.schedules import linear, schedule


@pytest.mark.parametrize(("end", "expected"), [(None, [3.0, 3.0, 3.0]), (-1.0, [3.0, 2.0, -1.0])])
def test_values_move_linearly_or_not_at_all(end, expected):
    assert [linear(3.0, end, progress) for progress in (0.0, 0.25, 1.0)] == expected


@pytest.mark.parametrize(
    ("start", "end", "entropies"),  # at the beginning, after a quarter, and at the end
    [(None, None, [-3.0, -3.0, -3.0]), (-1.0, None, [-1.0, -1.0, -1.0]), (None, 5.0, [-3.0, -1.0, 5.0]), (4.0, 0.0, [4.0, 3.0, 0.0])],
)
def test_target_entropy_by_hand(start, end, entropies):
    config = AgentConfig(target_entropy=start, final_target_entropy=end)
    assert [schedule(progress, 0, config, action_dim=3).target_entropy for progress in (0.0, 0.25, 1.0)] == entropies


def test_learning_rate_moves_linearly_or_not_at_all():
    moving = AgentConfig(learning_rate=1e-3, final_learning_rate=1e-4)
    assert np.allclose([schedule(progress, 0, moving, action_dim=1).learning_rate for progress in (0.0, 0.5, 1.0)], [1e-3, 5.5e-4, 1e-4])
    constant = AgentConfig(learning_rate=1e-3, final_learning_rate=None)
    assert [schedule(progress, 0, constant, action_dim=1).learning_rate for progress in (0.0, 1.0)] == [1e-3, 1e-3]


def test_span_of_the_average_by_hand():
    for rate, span, expected in ((0.2, 0.0, [0.2, 0.2, 0.2]), (1.0, 0.5, [1.0, 2 / 3, 0.1]), (0.3, 0.5, [0.3, 0.3, 0.1])):
        config = AgentConfig(actor_average_rate=rate, actor_average_span=span)
        rates = [schedule(0.0, updates, config, action_dim=1).actor_average_rate for updates in (0, 1, 18)]
        np.testing.assert_allclose(rates, expected, rtol=1e-6)


def test_weight_of_cloning_moves_linearly_or_not_at_all():
    config = AgentConfig(bc_weight=0.4, final_bc_weight=0.0)
    assert [schedule(progress, 0, config, action_dim=1).bc_weight for progress in (0.0, 0.25, 1.0)] == pytest.approx([0.4, 0.3, 0.0])
    assert schedule(0.5, 0, AgentConfig(bc_weight=0.4), action_dim=1).bc_weight == 0.4
