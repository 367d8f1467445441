"""Rotations there and back, against SciPy."""

import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from hindrl_jax.envs import rotations

to_vectors = jax.jit(jax.vmap(rotations.to_rotation_vector))
from_vectors = jax.jit(jax.vmap(rotations.from_rotation_vector))
six_d = jax.jit(jax.vmap(rotations.to_six_d))
between = jax.jit(jax.vmap(rotations.between))
UNIT_VECTORS = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1).map(lambda v: np.array(v) / np.linalg.norm(v))


@hypothesis.given(axis=UNIT_VECTORS, angle=st.floats(0, np.pi))
@hypothesis.example(axis=np.array([1.0, 0, 0]), angle=np.pi)  # a hand that points straight down
@hypothesis.example(axis=np.array([0, -0.6, 0.8]), angle=np.pi)
@hypothesis.example(axis=np.array([0, 0, 1.0]), angle=np.pi - 1e-3)
@hypothesis.example(axis=np.array([0, 0.6, 0.8]), angle=1e-4)
@hypothesis.example(axis=np.array([0, 0, -1.0]), angle=1e-30)
@hypothesis.example(axis=np.array([0, 0, 1.0]), angle=0.0)
@hypothesis.settings(deadline=None, max_examples=60)
def test_rotation_vectors_there_and_back(axis, angle):
    vector = np.float32(angle * axis)
    matrix = from_vectors(vector[None])
    np.testing.assert_allclose(matrix[0], Rotation.from_rotvec(vector).as_matrix(), atol=1e-6)
    back = np.asarray(to_vectors(matrix)[0])
    assert np.linalg.norm(back) <= np.pi + 1e-6
    if angle < np.pi - 1e-5:
        np.testing.assert_allclose(back, vector, atol=3e-6)
    else:  # where an axis and its opposite mean the same
        assert min(np.abs(back - vector).max(), np.abs(back + vector).max()) < 3e-6


def test_rotation_vectors_of_matrices_are_those_of_scipy():
    matrices = Rotation.random(200, random_state=0).as_matrix()
    found = to_vectors(jnp.asarray(matrices, jnp.float32))
    np.testing.assert_allclose(found, Rotation.from_matrix(matrices).as_rotvec(), atol=1e-5)


def test_six_d_is_continuous_where_rotation_vectors_jump():
    axes = Rotation.random(50, random_state=1).as_matrix()[:, 0]
    vectors = np.concatenate([(np.pi - 1e-3) * axes, -(np.pi - 1e-3) * axes]).astype(np.float32)  # 2e-3 rad apart, from both sides of pi
    matrices = from_vectors(vectors)
    found = np.asarray(six_d(matrices))
    assert np.abs(found[:50] - found[50:]).max() < 2.1e-3
    assert np.linalg.norm(to_vectors(matrices)[:50] - to_vectors(matrices)[50:], axis=1).min() > 6.0
    # It is the whole rotation: the third column follows.
    np.testing.assert_allclose(np.cross(found[:, :3], found[:, 3:]), matrices[:, :, 2], atol=1e-6)
    np.testing.assert_allclose(jax.vmap(rotations.from_six_d)(found), matrices, atol=1e-6)


def test_between_turns_the_source_into_the_target_in_the_axes_of_the_base():
    source, target = (Rotation.random(100, random_state=seed) for seed in (2, 3))
    found = between(jnp.asarray(source.as_matrix(), jnp.float32), jnp.asarray(target.as_matrix(), jnp.float32))
    np.testing.assert_allclose((Rotation.from_rotvec(found) * source).as_matrix(), target.as_matrix(), atol=1e-5)
    quarter = between(jnp.eye(3)[None], jnp.array([[[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]]))  # x becomes y: about +z
    np.testing.assert_allclose(quarter, [[0, 0, np.pi / 2]], atol=1e-6)
