"""What the closed form's socket does with a plug, by hand, and the distance of segments that hands are made of."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hindrl_jax.envs.cable import closed_form, contact, geometry

SOCKET = closed_form.start(jax.random.key(0), jnp.zeros((2, 7)), randomised=False).socket


def heads(height, aside=0.0, tilt=0.0, turn=None):
    """Both heads, the plug's tip so many m over the mouth and aside, tilted by so many rad; the socket turned by a rotation vector."""
    whole = Rotation.from_rotvec([0.3, -0.2, 0.5] if turn is None else turn)
    plug = Rotation.from_rotvec([tilt, 0, 0]) * Rotation.from_rotvec([0, np.pi, 0])  # its axis is opposite to the socket's
    tip = np.array([0, aside, geometry.to_tip(1) + height])
    positions = np.stack([tip - geometry.to_tip(0) * plug.as_matrix()[:, 2], np.zeros(3)])
    rotations = np.stack([(whole * plug).as_matrix(), whole.as_matrix()])
    return jnp.asarray(whole.apply(positions), jnp.float32), jnp.asarray(rotations, jnp.float32)


@functools.partial(jax.jit)
def correction(before, after):
    shift, turn = contact.plug_in_socket(before, after, SOCKET)
    shift, turn = (jnp.sum(after[1][1] * vector[:, None], axis=0) for vector in (shift, turn))  # in the socket's axes
    return jnp.concatenate([shift, turn])


def test_a_plug_outside_is_free():
    np.testing.assert_allclose(correction(heads(0.01), heads(0.003, aside=0.001, tilt=0.2)), 0.0, atol=1e-7)
    np.testing.assert_allclose(correction(heads(0.01, aside=0.02), heads(-0.02, aside=0.02)), 0.0, atol=1e-7)  # beside the sleeve


def test_a_plug_in_line_enters():
    np.testing.assert_allclose(correction(heads(0.001), heads(-0.003, aside=0.0002, tilt=0.01)), 0.0, atol=1e-7)


@pytest.mark.parametrize(
    ("aside", "tilt", "enters"),
    [
        (0.0029, 0.0, True),  # 3 mm, as far as the chamfer takes it
        (0.0031, 0.0, False),
        (0.0, np.radians(3.3), True),
        (0.0, np.radians(3.5), False),
        (0.0029, np.radians(3.3), True),
        (0.0, 0.3, False),
    ],
)
def test_what_enters_and_what_is_blocked(aside, tilt, enters):
    found = correction(heads(0.001, aside, tilt), heads(-0.003, aside, tilt))
    height = -0.003 + found[2]
    if enters:
        assert height < -0.0005
        assert abs(aside + found[1]) <= geometry.CLEARANCE + 1e-6  # the chamfer has brought it in line
    else:
        assert height == pytest.approx(geometry.CHAMFER if aside > 0.003 else 0.0, abs=1e-6)  # not a bit of it is in
        np.testing.assert_allclose(found[np.array([0, 1, 3, 4, 5])], 0.0, atol=1e-6)  # and nothing brings it in line


def test_one_that_is_blocked_stays_out_however_long_it_is_pressed():
    before, oblique = heads(0.0005, 0.0, 0.1), heads(-0.0035, 0.0, 0.1)
    for _ in range(3):
        found = correction(before, oblique)
        before = heads(-0.0035 + float(found[2]), 0.0, 0.1)
        assert found[2] == pytest.approx(0.0035, abs=1e-5)


def test_nothing_gets_in_through_the_wall():
    found = correction(heads(-0.02, aside=0.016), heads(-0.02, aside=0.012))
    np.testing.assert_allclose(found, [0, 0.0137 - 0.012, 0, 0, 0, 0], atol=1e-6)  # out to where the pin touches the sleeve


def test_walls_hold_the_plug_sideways_and_friction_holds_it_back():
    found = correction(heads(-0.010), heads(-0.014, aside=0.0023))
    # 2 mm too far aside; 0.3 of that less far in: 3.4 mm in place of 4
    np.testing.assert_allclose(found, [0, -0.002, 0.0006, 0, 0, 0], atol=1e-6)


def test_a_turning_hand_jams_the_plug_most_near_the_mouth():
    def advance(depth):
        """Of 4 mm, turned by 5 mrad more than the clearance leaves at the depth."""
        return float(0.004 - correction(heads(-depth + 0.004), heads(-depth, tilt=0.0006 / depth + 0.005))[2])

    assert advance(0.012) == pytest.approx(0.004 - 0.3 * 0.02 * 0.005 / 0.012, abs=1e-5)
    assert advance(0.030) == pytest.approx(0.004 - 0.3 * 0.02 * 0.005 / 0.030, abs=1e-5)
    found = correction(heads(-0.021), heads(-0.025, tilt=0.03))
    turned = 0.03 - 0.0006 / 0.025  # beyond what the clearance leaves at this depth
    assert np.linalg.norm(found[3:]) == pytest.approx(turned, rel=1e-3)
    assert found[2] == pytest.approx(0.3 * 0.02 * turned / 0.025, rel=1e-2)


def test_pressed_much_against_the_wall_it_does_not_advance():
    found = correction(heads(-0.010), heads(-0.011, aside=0.006))
    assert -0.011 + found[2] == pytest.approx(-0.010, abs=1e-6)


def test_friction_holds_back_one_that_is_pulled_out_too():
    found = correction(heads(-0.014), heads(-0.010, aside=0.0023))
    assert -0.010 + found[2] == pytest.approx(-0.0106, abs=1e-6)


def test_the_bottom_stops_it():
    found = correction(heads(-0.030), heads(-0.034))
    assert -0.034 + found[2] == pytest.approx(-geometry.DEPTH, abs=1e-6)


def test_heads_that_hang_side_by_side_are_free_though_their_axes_agree():
    positions, rotations = jnp.asarray(geometry.HANGING_GRIPS), jnp.stack([jnp.asarray(geometry.HANGING)] * 2)
    np.testing.assert_array_equal(correction((positions, rotations), (positions, rotations)), 0.0)


@pytest.mark.parametrize(
    ("first", "second", "expected"),
    [
        ([[0, 0, 0], [2, 0, 0]], [[1, 1, 3], [1, -1, 3]], [0, 0, -3]),  # they cross
        ([[0, 0, 0], [1, 0, 0]], [[3, 4, 0], [5, 4, 0]], [-2, -4, 0]),  # end to end
        ([[0, 0, 0], [1, 0, 0]], [[0, 2, 0], [1, 2, 0]], [0, -2, 0]),  # parallel
    ],
)
def test_way_between_segments(first, second, expected):
    found = contact.between_segments(jnp.asarray(first, jnp.float32), jnp.asarray(second, jnp.float32))
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_hands_are_pushed_apart():
    down = jnp.stack([jnp.diag(jnp.array([1.0, -1.0, -1.0]))] * 2)
    apart = contact.hands_apart(jnp.array([[0.0, 0.0, 0.0], [0.2, 0.0, 0.0]]), down)
    np.testing.assert_array_equal(apart, 0.0)
    apart = contact.hands_apart(jnp.array([[0.0, 0.0, 0.0], [0.05, 0.0, 0.0]]), down)  # palms of radius 30 mm, 50 mm apart
    np.testing.assert_allclose(apart, [-0.01, 0.0, 0.0], atol=1e-6)
