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
    [(-1.0, None, [-3.0, -3.0, -3.0]), (-1.0, -2.0, [-3.0, -3.75, -6.0]), (2.0, 0.0, [6.0, 4.5, 0.0])],
)
def test_target_entropy_of_three_dimensions_by_hand(start, end, entropies):
    config = AgentConfig(target_entropy=start, final_target_entropy=end)
    assert [schedule(progress, 0, config, action_dim=3).target_entropy for progress in (0.0, 0.25, 1.0)] == entropies


@pytest.mark.parametrize(("span", "rates"), [(0.0, [1.0, 1.0, 1.0]), (0.5, [1.0, 2 / 3, 0.1]), (1.0, [1.0, 1 / 2, 1 / 19])])
def test_span_of_the_average_by_hand(span, rates):
    # 1 / (1 + span * updates), after 0, 1 and 18 updates; without a span the average is the actor itself.
    config = AgentConfig(actor_average_span=span)
    found = [schedule(0.0, updates, config, action_dim=1).actor_average_rate for updates in (0, 1, 18)]
    np.testing.assert_allclose(found, rates, rtol=1e-6)
