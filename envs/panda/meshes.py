"""How the arm looks: robosuite's meshes where robosuite is installed, the capsules of panda.xml where it is not.

Both belong to the bodies of panda.xml, so that what is shown is what is simulated.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

from hindrl_jax.envs.panda import robot

mujoco = robot.import_mujoco()

_FILES = {  # of robosuite, each with the bodies that have another name in panda.xml
    "robots/panda/robot.xml": {},
    "grippers/panda_gripper.xml": {"right_gripper": "gripper", "leftfinger": "left_finger", "rightfinger": "right_finger"},
}


def visible_model() -> Any:
    """The MuJoCo model to draw: panda.xml, with robosuite's meshes if robosuite is there. (It is not imported, which would take seconds.)"""
    return with_meshes(robot.MODEL_PATH.read_text(), [""]) or robot.model()


def with_meshes(xml: str, prefixes: list[str]) -> Any:
    """A MuJoCo model with robosuite's meshes in place of the capsules of its arms; None where robosuite is not there, or is another version.

    Args:
      xml: the model.
      prefixes: of the names of each arm's bodies, which after it are those of panda.xml.
    """
    robosuite = importlib.util.find_spec("robosuite")
    if robosuite is None or robosuite.origin is None:
        return None
    try:
        spec = mujoco.MjSpec.from_string(xml)
        arms = {prefix + body.name for prefix in prefixes for body in mujoco.MjSpec.from_file(str(robot.MODEL_PATH)).bodies}
        for body in spec.bodies:
            for geom in body.geoms:
                if body.name in arms and (geom.type == mujoco.mjtGeom.mjGEOM_CAPSULE or body.name.endswith("gripper")):
                    spec.delete(geom)
        for file, names in _FILES.items():
            for prefix in prefixes:
                _add_meshes(spec, Path(robosuite.origin).parent / "models" / "assets" / file, names, prefix)
        return spec.compile()
    except (ValueError, AttributeError, KeyError):  # a version of robosuite whose files or bodies are others
        return None


def _add_meshes(spec: Any, file: Path, names: dict[str, str], prefix: str) -> None:
    """Adds the visible meshes of robosuite's file to the bodies of an arm: those of the same name, or else as `names` has it."""
    source = mujoco.MjSpec.from_file(str(file))
    colours = {material.name: material.rgba for material in source.materials}
    meshes = {mesh.name: mesh for mesh in source.meshes}
    used = {mesh.name for mesh in spec.meshes}
    for body in source.bodies:
        for geom in body.geoms:
            if geom.group != 1:  # the others are for collisions
                continue
            if geom.meshname not in used:
                used.add(geom.meshname)
                spec.add_mesh(name=geom.meshname, file=str(file.parent / meshes[geom.meshname].file))
            looks = {"rgba": colours.get(geom.material, geom.rgba), "group": 1, "contype": 0, "conaffinity": 0, "mass": 0}
            place = {"pos": geom.pos, "quat": geom.quat}
            spec.body(prefix + names.get(body.name, body.name)).add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=geom.meshname, **place, **looks)
