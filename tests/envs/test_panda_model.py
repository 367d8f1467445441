"""The model file against robosuite's arm, which it restates."""

import importlib.util

import numpy as np
import pytest
from mujoco_twin import mujoco_at

from hindrl_jax.envs import panda
from hindrl_jax.envs.reach import FixedParameterizedReach


@pytest.fixture(scope="module")
def theirs():
    """robosuite's compiled model of its whole scene, and data at the initial configuration with closed fingers."""
    if importlib.util.find_spec("robosuite") is None:  # importorskip would import it, with all its side effects
        pytest.skip("robosuite is not installed")
    from hindrl_jax.experts.robosuite_arm import shared_scene

    arm = shared_scene(FixedParameterizedReach(num_waypoints=2))
    arm.reset(np.array(panda.INITIAL_JOINTS))
    return arm.environment.sim.model._model, arm.environment.sim.data._data


BODIES = {f"link{i}": f"robot0_link{i}" for i in range(8)} | {
    "hand": "robot0_right_hand",
    "gripper": "gripper0_right_right_gripper",
    "left_finger": "gripper0_right_leftfinger",
    "right_finger": "gripper0_right_rightfinger",
    "left_tip": "gripper0_right_finger_joint1_tip",
    "right_tip": "gripper0_right_finger_joint2_tip",
}


def test_bodies_are_those_of_robosuite(theirs):
    model, data = theirs
    ours, mine = panda.model(), mujoco_at(panda.INITIAL_JOINTS)
    base = data.body("robot0_link0")
    axes = base.xmat.reshape(3, 3)
    assert {ours.body(i).name for i in range(1, ours.nbody)} == set(BODIES)
    for name, their_name in BODIES.items():
        a, b = ours.body(name), model.body(their_name)
        # Where the body is and how it lies, in the axes of the base.
        np.testing.assert_allclose(mine.body(name).xpos, axes.T @ (data.body(their_name).xpos - base.xpos), atol=1e-5, err_msg=name)
        np.testing.assert_allclose(mine.body(name).xmat.reshape(3, 3), axes.T @ data.body(their_name).xmat.reshape(3, 3), atol=1e-5, err_msg=name)
        np.testing.assert_allclose(a.mass, b.mass, rtol=1e-6, err_msg=name)
        np.testing.assert_allclose(mine.body(name).xipos, axes.T @ (data.body(their_name).xipos - base.xpos), atol=1e-5, err_msg=name)
        # The moments of inertia about the base's axes: equal moments may stand in another order.
        mine_axes, their_axes = mine.body(name).ximat.reshape(3, 3), axes.T @ data.body(their_name).ximat.reshape(3, 3)
        np.testing.assert_allclose(
            mine_axes @ np.diag(a.inertia) @ mine_axes.T, their_axes @ np.diag(b.inertia) @ their_axes.T, atol=1e-6, err_msg=name
        )
    assert model.body("robot0_link0").subtreemass[0] == pytest.approx(ours.body_mass.sum())  # nothing is missing
    site = data.site("gripper0_right_grip_site")
    np.testing.assert_allclose(mine.site("grip_site").xpos, axes.T @ (site.xpos - base.xpos), atol=1e-5)


def test_joints_are_those_of_robosuite(theirs):
    model, _ = theirs
    ours = panda.model()
    assert ours.nv == 7
    for i in range(7):
        a, b = ours.joint(f"joint{i + 1}"), model.joint(f"robot0_joint{i + 1}")
        np.testing.assert_allclose(a.range, b.range, atol=1e-6)
        np.testing.assert_allclose(a.axis, b.axis, atol=1e-6)
        for name in ("armature", "damping", "frictionloss", "stiffness"):
            np.testing.assert_allclose(getattr(ours, f"dof_{name}" if name != "stiffness" else "jnt_stiffness")[i], getattr(b, name), rtol=1e-6)
        for name in ("dof_solref", "dof_solimp", "jnt_solref", "jnt_solimp"):
            address = b.id if name.startswith("jnt") else b.dofadr[0]
            np.testing.assert_allclose(getattr(ours, name)[i], getattr(model, name)[address], rtol=1e-6)
        motor = [k for k in range(model.nu) if model.actuator_trnid[k, 0] == b.id]
        assert len(motor) == 1
        np.testing.assert_allclose(ours.actuator_ctrlrange[i], model.actuator_ctrlrange[motor[0]], rtol=1e-6)
    for name in ("timestep", "density", "viscosity", "integrator"):
        assert getattr(ours.opt, name) == getattr(model.opt, name)
