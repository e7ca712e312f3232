"""Brings runs that earlier versions wrote to the form that this version writes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torch import Tensor

_RENAMED = {"control_points": {"motion.nodes": "motion.control_points"}}
"""By motion: parameters that schema 1 called otherwise."""

_ADDED = {"density": {"reset_opacity": 0.01}}
"""Options that schema 1 did not have, and what was done in their place."""


def present_options(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options of a run of schema 1 with those that schema 2 has besides."""
    added = {topic: more | options[topic] for topic, more in _ADDED.items()}
    return {**options, **added}


def present_tensors(tensors: Mapping[str, Tensor], motion: str) -> dict[str, Tensor]:
    """Return the tensors of a checkpoint of schema 1 under the names of schema 2.

    Args:
        tensors: of the model, its last values (``last.``) and Adam's moments (``adam.first.``).
        motion: present name of the run's motion.
    """
    return {_present_name(name, motion): tensor for name, tensor in tensors.items()}


def present_state(state: Mapping[str, Any], motion: str) -> dict[str, Any]:
    """Return the state of a checkpoint of schema 1 as schema 2 has it.

    Versions before 0.2 had a fixed list of events, whose counts were part of the state itself.
    """
    found = {"adam_restarts": {}, "dropped": 0, **state}
    for key in ("adam_steps", "adam_restarts"):
        found[key] = {_present_name(name, motion): count for name, count in found[key].items()}
    if "events" not in state:
        found["events"] = {
            "density": {"rounds": found.pop("rounds")},
            "opacity_reset": {"count": found.pop("resets")},
            "thinning": {"count": found.pop("thinnings", 0)},
        }
    return found


def _present_name(name: str, motion: str) -> str:
    for old, new in _RENAMED.get(motion, {}).items():
        if name == old or name.endswith(f".{old}"):
            return name.removesuffix(old) + new
    return name
