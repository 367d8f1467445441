"""The MuJoCo model of the cable tasks, the reference for the closed form: two Pandas with sliding fingers, two cables of rigid links, plug, socket.

It has no meshes, so that MJX takes it, and the pairs of bodies that can touch are listed: pads and grips, pin and bore, hands and hands. Cables touch
nothing. What holds and what does not was found out with a shaky expert, since a steady one never shows that a plug can be thrown out of a firm grip
within one step of 5 ms, without a warning:

  * pyramidal friction cones with impratio 10, and 50 iterations of the solver's line search; with elliptic cones and 10 it happens;
  * stiff contacts (solimp), as MuJoCo's own give way by an amount that makes the pin of 12 g pass through the bore's bottom of 6 mm.
"""

from __future__ import annotations

import functools
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from typing import Any

import numpy as np

from hindrl_jax.envs import panda
from hindrl_jax.envs.cable import geometry
from hindrl_jax.envs.panda import position_actuators

HEADS = ("plug", "socket")
"""Prefixes of the names of all that belongs to the one cable and its arm, or to the other."""
_WALLS = 8  # of the bore
_WALL = 0.0035  # m, half of their thickness
_GRIP_CONTACT = {"condim": 4, "friction": "2 2 0.05 0.0001 0.0001", "solref": "0.01 1", "solimp": "0.99 0.999 0.001"}
_PIN_CONTACT = {"condim": 3, "friction": "0.2 0.2 0.005 0.0001 0.0001", "solref": "0.01 1", "solimp": "0.99 0.999 0.001"}
_LEAST_INERTIA = 2e-6  # kg m^2; what is thinner spins
_OPTIONS = """
<mujoco model="cables">
  <compiler angle="radian" autolimits="true" inertiafromgeom="false"/>
  <option timestep="0.005" integrator="implicitfast" cone="pyramidal" impratio="10" iterations="20" ls_iterations="50"/>
  <default>
    <geom contype="0" conaffinity="0" mass="0"/>
  </default>
  <visual>
    <headlight ambient="0.38 0.38 0.38" diffuse="0.34 0.34 0.34" specular="0.08 0.08 0.08"/>
    <global offwidth="960" offheight="960"/>
    <quality shadowsize="0" numslices="20" numstacks="6" numquads="1"/>
  </visual>
  <asset>
    <texture name="sky" type="skybox" builtin="flat" rgb1="1 1 1" rgb2="1 1 1" width="8" height="8"/>
    <material name="shell" rgba="0.88 0.89 0.91 1" specular="0.4" shininess="0.5"/>
    <material name="joint" rgba="0.28 0.30 0.34 1" specular="0.4" shininess="0.5"/>
    <material name="table" rgba="0.95 0.96 0.97 1" specular="0" shininess="0"/>
    <material name="bar" rgba="0.66 0.69 0.73 1" specular="0.2" shininess="0.3"/>
    <material name="cable" rgba="0.22 0.24 0.28 1" specular="0.2" shininess="0.3"/>
    <material name="plug" rgba="0.85 0.26 0.20 1" specular="0.3" shininess="0.5"/>
    <material name="pin" rgba="0.86 0.72 0.25 1" specular="0.6" shininess="0.8"/>
    <material name="socket" rgba="0.18 0.43 0.84 1" specular="0.3" shininess="0.5"/>
  </asset>
  <worldbody>
    <light pos="1.5 0 3" dir="-0.6 0 -0.8" directional="true" diffuse="0.25 0.25 0.25" specular="0 0 0" castshadow="false"/>
    <light pos="0.5 -1 3" dir="-0.3 0.4 -0.8" directional="true" diffuse="0.25 0.25 0.25" castshadow="false"/>
    <geom name="floor" type="plane" size="0.5 0.55 0.1" pos="-0.6 0 0.812" material="table"/>
  </worldbody>
  <contact/>
  <actuator/>
</mujoco>
"""


@functools.cache
def model(num_links: int) -> Any:
    """The compiled MuJoCo model."""
    mujoco = panda.import_mujoco()
    return mujoco.MjModel.from_xml_string(xml(num_links))


def xml(num_links: int) -> str:
    """The model as text, with that many links in each cable.

    With none there are no cables, and the heads are free bodies: to draw, wherever they are.
    """
    root = ET.fromstring(_OPTIONS)
    world, contact, actuator = (root.find(name) for name in ("worldbody", "contact", "actuator"))
    bar, *cables = hanging(num_links)
    world.append(bar)
    for index, name in enumerate(HEADS):
        world.append(_arm(name, geometry.BASES[index]))
        _add_actuators(actuator, name)
    world.extend(cables)
    contact.extend(pairs([[f"{name}_{side}_pad" for side in ("left", "right")] for name in HEADS]))
    for first in ("palm", "left_bar", "right_bar"):
        for second in ("palm", "left_bar", "right_bar"):
            _add(contact, "pair", geom1=f"plug_{first}", geom2=f"socket_{second}", condim=1)
    ET.indent(root)
    return ET.tostring(root, encoding="unicode")


def materials() -> list[ET.Element]:
    """What `hanging` is painted with."""
    return ET.fromstring(_OPTIONS).findall("asset/material")


def hanging(num_links: int) -> list[ET.Element]:
    """The bar, and the two cables that hang from it, for the world of any model whose geoms have no mass and touch nothing unless they say so."""
    x, _, z = geometry.ANCHORS[0]
    root = ET.Element("worldbody")
    _add(root, "geom", name="bar", type="capsule", fromto=(x, -0.45, z, x, 0.45, z), size=0.01, material="bar")
    return [*root, *(_cable(name, index, num_links) for index, name in enumerate(HEADS))]


def pairs(pads: Sequence[Sequence[str]]) -> list[ET.Element]:
    """What touches: pads and grips, pin and bore, plug and socket.

    Args:
      pads: for the plug and for the socket, the names of the geoms that are the pads of their arm's fingers.
    """
    contact = ET.Element("contact")
    for name, of_arm in zip(HEADS, pads, strict=True):
        for pad in of_arm:
            _add(contact, "pair", geom1=pad, geom2=f"{name}_grip", **_GRIP_CONTACT)
    for k in range(_WALLS):
        for part in ("wall", "slant"):
            _add(contact, "pair", geom1="pin", geom2=f"{part}{k}", **_PIN_CONTACT)
    _add(contact, "pair", geom1="pin", geom2="bottom", **_PIN_CONTACT)
    _add(contact, "pair", geom1="plug_body", geom2="socket_body", condim=1)
    return list(contact)


def joint_names(num_links: int) -> list[str]:
    """The joints of the cables, as they stand in the state of `chains`."""
    return [joint.get("name", "") for cable in hanging(num_links)[1:] for joint in cable.iter("joint")]


def _add(parent: ET.Element, tag: str, **attributes: Any) -> ET.Element:
    """A new element, whose attributes may be numbers, or several of them."""
    return ET.SubElement(parent, tag, {name: _written(value) for name, value in attributes.items()})


def _written(value: Any) -> str:
    return value if isinstance(value, str) else " ".join(f"{number:.9g}" for number in np.ravel(value))


def _arm(name: str, base: np.ndarray) -> ET.Element:
    """The arm of panda.xml, on its base, without gravity and dry friction, with fingers that slide, and with what touches."""
    source = ET.parse(panda.MODEL_PATH).getroot()
    arm = source.find("worldbody/body")
    for body in arm.iter("body"):
        body.set("gravcomp", "1")
    for geom in arm.iter("geom"):
        geom.attrib = {"type": "capsule", "material": "shell", "group": "1"} | geom.attrib
    for joint in arm.iter("joint"):
        joint.attrib = {"axis": "0 0 1", "damping": "0.1"} | joint.attrib
    bodies = {body.get("name"): body for body in arm.iter("body")}
    for geom in bodies["gripper"].findall("geom[@type='box']"):  # the closed fingers
        bodies["gripper"].remove(geom)
    _add(bodies["gripper"], "geom", name="palm", type="capsule", fromto=(-0.07, 0, 0.03, 0.07, 0, 0.03), size=0.03, group="3")
    for side, sign in (("left", 1), ("right", -1)):
        limits = (0.0, geometry.MAX_FINGER) if sign > 0 else (-geometry.MAX_FINGER, 0.0)
        slide = ET.Element("joint", {"name": f"{side}_slide", "type": "slide", "axis": "0 1 0", "range": _written(limits)} | _FINGER)
        bodies[f"{side}_finger"].insert(1, slide)
        tip = bodies[f"{side}_tip"]
        _add(tip, "geom", name=f"{side}_pad", type="box", size=(0.008, 0.004, 0.008), pos=(0, -0.005 * sign, -0.015), material="joint")
        along = (0, 0.006 * sign, -0.045, 0, 0.006 * sign, -0.015)
        _add(tip, "geom", name=f"{side}_bar", type="capsule", fromto=along, size=0.008, material="joint")
    for element in arm.iter():
        if "name" in element.attrib:
            element.set("name", f"{name}_{element.get('name')}")
    arm.set("pos", _written(base))
    return arm


_FINGER = {"damping": "100", "armature": "1"}


def _add_actuators(actuator: ET.Element, name: str) -> None:
    gains = zip(position_actuators.POSITION_GAINS, position_actuators.VELOCITY_GAINS, position_actuators.FORCE_LIMITS, strict=True)
    for index, (kp, kv, force) in enumerate(gains):
        _add(actuator, "position", joint=f"{name}_joint{index + 1}", kp=kp, kv=kv, forcerange=(-force, force))
    for side, limits in (("left", (0.0, geometry.MAX_FINGER)), ("right", (-geometry.MAX_FINGER, 0.0))):
        _add(actuator, "position", joint=f"{name}_{side}_slide", kp=1000, ctrlrange=limits, forcerange=(-20, 20))


def _cable(name: str, index: int, num_links: int) -> ET.Element:
    """A chain of links, each on two hinges, and the head on three; the local z axis runs along it, from the bar down."""
    if num_links == 0:
        head = ET.Element("body", name=f"{name}_head")
        _add(head, "freejoint")
        _add_head(head, name, index)
        return head
    length, mass = geometry.CABLE_LENGTH / num_links, geometry.CABLE_MASS / num_links
    root = ET.Element("body", name=f"{name}_stand", pos=_written(geometry.ANCHORS[index]), quat="0 1 0 0")
    parent = root
    for i in range(num_links):
        link = _add(parent, "body", name=f"{name}_piece{i}", pos=(0, 0, length if i else 0))
        _add_hinges(link, f"{name}_cable{i}", damping=0.05 if i == 0 else 0.0125)
        slender = max(mass * length**2 / 12, _LEAST_INERTIA)
        _add(link, "inertial", pos=(0, 0, length / 2), mass=mass, diaginertia=(slender, slender, _LEAST_INERTIA))
        _add(link, "geom", type="capsule", fromto=(0, 0, 0, 0, 0, length), size=geometry.CABLE_RADIUS, material="cable")
        parent = link
    head = _add(parent, "body", name=f"{name}_head", pos=(0, 0, length))
    _add_hinges(head, f"{name}_head", damping=0.0125)
    _add(head, "joint", name=f"{name}_head_z", type="hinge", axis="0 0 1", damping=0.002, armature=1e-5)
    _add_head(head, name, index)
    return root


def _add_head(head: ET.Element, name: str, index: int) -> None:
    mass = geometry.HEAD_MASSES[index]
    slender = mass * 0.092**2 / 12
    _add(head, "inertial", pos=(0, 0, geometry.HEAD_CENTRES[index]), mass=mass, diaginertia=(slender, slender, _LEAST_INERTIA))
    _add(head, "geom", name=f"{name}_body", type="capsule", fromto=(0, 0, 0.008, 0, 0, 0.052), size=0.008, material=name)
    grip = (0, 0, 0, 0, 0, 2 * geometry.GRIP_HALF_LENGTH)
    _add(head, "geom", name=f"{name}_grip", type="capsule", fromto=grip, size=geometry.GRIP_RADIUS, material=name)
    _add(head, "site", name=f"{name}_grip", pos=(0, 0, geometry.GRIP))
    _add(head, "site", name=f"{name}_tip", pos=(0, 0, geometry.TIPS[index]))
    (_add_pin if index == 0 else _add_bore)(head)


def _add_hinges(body: ET.Element, name: str, *, damping: float) -> None:
    for axis, direction in (("x", "1 0 0"), ("y", "0 1 0")):
        _add(body, "joint", name=f"{name}_{axis}", type="hinge", axis=direction, damping=damping, armature=1e-5)


def _add_pin(head: ET.Element) -> None:
    end = geometry.TIPS[0] - geometry.PIN_RADIUS
    _add(head, "geom", name="pin", type="capsule", fromto=(0, 0, geometry.PIN_START, 0, 0, end), size=geometry.PIN_RADIUS, material="pin")


def _add_bore(head: ET.Element) -> None:
    """A ring of boxes as walls, a ring of slanted ones as chamfer around the mouth, and a block as the bottom."""
    radius, mouth, bottom = geometry.PIN_RADIUS + geometry.CLEARANCE, geometry.TIPS[1], geometry.SOCKET_BOTTOM
    start, widen = 0.062, geometry.CHAMFER
    half_side = np.tan(np.pi / _WALLS)
    for k in range(_WALLS):
        angle = 2 * np.pi * k / _WALLS
        outwards = np.array([np.cos(angle), np.sin(angle), 0.0])
        about_z = _quaternion([0, 0, 1], angle)
        place = (radius + _WALL) * outwards + [0, 0, (start + mouth) / 2]
        size = (_WALL, (radius + 2 * _WALL) * half_side, (mouth - start) / 2)
        _add(head, "geom", name=f"wall{k}", type="box", size=size, pos=place, quat=about_z, material="socket")
        # The slant's inner face runs from (radius, mouth) to (radius + widen, mouth + widen); the box is 2 mm thick behind it.
        behind = 0.001 * np.sqrt(0.5)
        place = (radius + widen / 2 + behind) * outwards + [0, 0, mouth + widen / 2 - behind]
        size = (0.001, (radius + widen) * half_side, widen * np.sqrt(0.5))
        turned = _quaternion_product(about_z, _quaternion([0, 1, 0], np.pi / 4))
        _add(head, "geom", name=f"slant{k}", type="box", size=size, pos=place, quat=turned, material="socket")
    _add(head, "geom", name="bottom", type="box", size=(0.009, 0.009, 0.025), pos=(0, 0, bottom - 0.025), material="socket")
    _add(head, "site", name="socket_bottom", pos=(0, 0, bottom))


def _quaternion(axis: Any, angle: float) -> np.ndarray:
    return np.concatenate([[np.cos(angle / 2)], np.sin(angle / 2) * np.asarray(axis, float)])


def _quaternion_product(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    return np.concatenate([[p[0] * q[0] - p[1:] @ q[1:]], p[0] * q[1:] + q[0] * p[1:] + np.cross(p[1:], q[1:])])
