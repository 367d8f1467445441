"""The Panda as a robot: its MuJoCo model, panda.xml, and the numbers of it that kinematics and dynamics in closed form need."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hindrl_jax.base.errors import UserError, one_line

MODEL_PATH = Path(__file__).with_name("panda.xml")
NUM_JOINTS = 7
INITIAL_JOINTS = (0.0, np.pi / 16, 0.0, -5 * np.pi / 6, 0.0, np.pi - 0.2, np.pi / 4)
"""(7,) rad, robosuite's initial configuration."""


@dataclass(frozen=True, eq=False)
class Chain:
    """The numbers of panda.xml that the closed form needs. Frames of the links are those at their joints, rotating about z."""

    offsets: np.ndarray  # (7, 3) m, origin of each link in the one before
    rotations: np.ndarray  # (7, 3, 3) orientation of each link in the one before, at joint angle 0
    hand_offset: np.ndarray  # (3,) m, grip site in link 7
    hand_rotation: np.ndarray  # (3, 3) orientation of the hand in link 7
    masses: np.ndarray  # (7,) kg; what is fixed to a link belongs to it
    centres: np.ndarray  # (7, 3) m, centre of mass in the link
    inertias: np.ndarray  # (7, 3, 3) kg m^2, about the centre of mass, in the link's axes
    drag_links: np.ndarray  # (K,) which link each of K bodies is fixed to
    drag_centres: np.ndarray  # (K, 3) m, centres of mass of these bodies in their links
    drag_axes: np.ndarray  # (K, 3, 3) their principal axes of inertia in their links
    drag_boxes: np.ndarray  # (K, 3) m, sides of the boxes with their inertia
    armature: np.ndarray  # (7,) kg m^2
    damping: np.ndarray  # (7,) N m s/rad
    friction: np.ndarray  # (7,) N m, largest dry friction
    friction_regularisation: np.ndarray  # (7,) R of MuJoCo's friction constraint, rad/s^2 per N m
    friction_rate: float  # 1/s, b of its reference acceleration -b v
    air_density: float  # kg/m^3
    lower: np.ndarray  # (7,) rad
    upper: np.ndarray  # (7,) rad


def import_mujoco() -> Any:
    """MuJoCo's module, imported late, since it loads the OpenGL library that MUJOCO_GL names, which may be missing though nothing is drawn.

    Raises:
      UserError: if it does not load.
    """
    try:
        import mujoco
    except Exception as error:  # of many kinds, depending on the library
        raise UserError(f"MuJoCo does not load ({one_line(error)}): install mujoco, and what MUJOCO_GL names or MUJOCO_GL=disable") from error
    return mujoco


@functools.cache
def model() -> Any:
    """The compiled MuJoCo model of panda.xml."""
    mujoco = import_mujoco()
    return mujoco.MjModel.from_xml_path(str(MODEL_PATH))


@functools.cache
def chain() -> Chain:
    """Reads the chain off the MuJoCo model, merging what is fixed to link 7 into it."""
    mujoco = import_mujoco()
    m = model()
    data = mujoco.MjData(m)
    mujoco.mj_kinematics(m, data)
    links = [m.joint(f"joint{i + 1}").bodyid[0] for i in range(NUM_JOINTS)]
    position, rotation = data.xpos, data.xmat.reshape(-1, 3, 3)
    parents = [m.body_parentid[link] for link in links]

    def fixed_to(link: int) -> list[int]:
        members = [link]
        for body in range(link + 1, m.nbody):
            if m.body_parentid[body] in members and m.body_jntnum[body] == 0:
                members.append(body)
        return members

    masses, centres, inertias, boxes = [], [], [], []
    for index, link in enumerate(links):
        members = fixed_to(link)
        weights = m.body_mass[members]
        places = (data.xipos[members] - position[link]) @ rotation[link]
        centre = weights @ places / weights.sum()
        inertia = np.zeros((3, 3))
        for body, weight, place in zip(members, weights, places, strict=True):
            axes, offset = rotation[link].T @ data.ximat[body].reshape(3, 3), place - centre
            inertia += axes @ np.diag(m.body_inertia[body]) @ axes.T + weight * (offset @ offset * np.eye(3) - np.outer(offset, offset))
            boxes.append((index, place, axes, _box_sides(weight, m.body_inertia[body])))
        masses.append(weights.sum())
        centres.append(centre)
        inertias.append(inertia)
    drag_links, drag_centres, drag_axes, drag_boxes = map(np.array, zip(*boxes, strict=True))

    site, hand = m.site("grip_site").id, m.body("hand").id
    impedance, largest_impedance = m.dof_solimp[0, :2]
    return Chain(
        offsets=np.array([(position[link] - position[parent]) @ rotation[parent] for parent, link in zip(parents, links, strict=True)]),
        rotations=np.array([rotation[parent].T @ rotation[link] for parent, link in zip(parents, links, strict=True)]),
        hand_offset=(data.site_xpos[site] - position[links[-1]]) @ rotation[links[-1]],
        hand_rotation=rotation[links[-1]].T @ rotation[hand],
        masses=np.array(masses),
        centres=np.array(centres),
        inertias=np.array(inertias),
        drag_links=drag_links,
        drag_centres=drag_centres,
        drag_axes=drag_axes,
        drag_boxes=drag_boxes,
        armature=np.array(m.dof_armature),
        damping=np.array(m.dof_damping),
        friction=np.array(m.dof_frictionloss),
        friction_regularisation=(1 - impedance) / impedance * m.dof_invweight0,
        friction_rate=float(2 / (largest_impedance * m.dof_solref[0, 0])),
        air_density=float(m.opt.density),
        lower=np.array(m.jnt_range[:, 0]),
        upper=np.array(m.jnt_range[:, 1]),
    )


def longest_reach() -> float:
    """How far the hand could be from the base, in m, if the arm were a rope: the sum of the distances from joint to joint."""
    c = chain()
    return float(np.linalg.norm(c.offsets, axis=1).sum() + np.linalg.norm(c.hand_offset))


def _box_sides(mass: float, inertia: np.ndarray) -> np.ndarray:
    """Sides (3,) of the homogeneous box with this mass and these principal moments."""
    return np.sqrt(6 / mass * (inertia.sum() - 2 * inertia))
