"""Experiments with equal environments and configs share their compiled programs, within a test process.

Most tests of whole runs train the same small tasks, and tracing, lowering and loading their programs again would be most of what they do.
"""

import collections
import dataclasses
import functools

import jax
from jax.sharding import Mesh

from hindrl_jax.training.host import HostPrograms
from hindrl_jax.training.host_playing import HostPolicies
from hindrl_jax.training.programs import JaxPrograms

MOST = 8  # of each kind; the one that was not used for the longest time is forgotten
_kept = collections.defaultdict(collections.OrderedDict)


def install():
    """For the rest of this process."""
    JaxPrograms._compile = _once(JaxPrograms._compile, _of_programs)
    HostPrograms._compile = _once(HostPrograms._compile, _of_programs)
    HostPolicies.__init__ = _once(HostPolicies.__init__, lambda policies, *given: given)


def forget():
    """Everything, which gives memory back."""
    _kept.clear()


def _once(method, key_of):
    """A method that gives its object attributes, which objects of equal keys are given without a call."""

    @functools.wraps(method)
    def wrapped(self, *given):
        try:
            key = _hashable(key_of(self, *given))
            hash(key)
        except TypeError:
            method(self, *given)
            return
        kept, before = _kept[method], set(vars(self))
        if key not in kept:
            method(self, *given)
            kept[key] = {name: value for name, value in vars(self).items() if name not in before}
            if len(kept) > MOST:
                kept.popitem(last=False)
        kept.move_to_end(key)
        vars(self).update(kept[key])
        if "shapes" in kept[key]:
            self._check_fits_into_memory(self.shapes["state"])

    return wrapped


def _of_programs(programs, *shapes):
    """What they depend on: when a run ends is none of it, nor how often its clone practises, but for never."""
    rounds = min(programs.config.practice_rounds, 1)
    return programs.env, dataclasses.replace(programs.config, stop_at=None, practice_rounds=rounds), programs.mesh, shapes


def _hashable(key):
    """Of what is equal by its values.

    Raises:
      TypeError: if there is something else in it, which may be the same object and have changed since.
    """
    leaves, structure = jax.tree.flatten(key)
    for leaf in leaves:
        if not isinstance(leaf, jax.ShapeDtypeStruct | Mesh) and not (dataclasses.is_dataclass(leaf) and leaf.__dataclass_params__.frozen):
            raise TypeError(f"{leaf} may have changed")
    return (*leaves, structure, jax.config.jax_enable_x64, jax.config.jax_debug_key_reuse)
