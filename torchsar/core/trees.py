"""Signals, recordings, truths and estimates as trees of tensors for torch.func and data loaders.

Importing this module registers them with torch.utils._pytree, so that `torch.func.vmap`, `grad` and
the other transforms accept and return them. It also registers them with
torch.utils.data.default_collate, so that a DataLoader stacks them into a batch with a new leading
trial dimension. The tensors are the leaves of the tree. All else (axes, radar, names, neutral
values that are numbers) is part of its structure and does not change.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import fields
from functools import partial
from typing import Any

from torch import Tensor
from torch.utils import _pytree as pytree
from torch.utils.data._utils.collate import collate, default_collate_fn_map

from torchsar.core.estimate import Estimate
from torchsar.core.signal import Axis, Recording, Signal, Truth

_NODES = (Tensor, Signal, Recording)
# attribute that stores the nodes and the structure of an object whose leaves are not tensors
_BARE = "_tree"
_Structure = tuple[tuple[str, ...], dict[str, Any]]


def _parts(x: Any) -> tuple[dict[str, Any], dict[str, Any]]:
    """Divide the fields of an object into those with tensors and the others.

    The entries of a mapping are divided in the same way.
    """
    nodes, static = {}, {}
    for name in (field.name for field in fields(x)):
        value = getattr(x, name)
        if isinstance(value, Mapping):
            nodes[name] = {key: entry for key, entry in value.items() if isinstance(entry, _NODES)}
            static[name] = {key: entry for key, entry in value.items() if not isinstance(entry, _NODES)}
        else:
            (nodes if isinstance(value, _NODES) else static)[name] = value
    return nodes, static


def _flatten(x: Any) -> tuple[list[Any], _Structure]:
    if hasattr(x, _BARE):
        return getattr(x, _BARE)
    nodes, static = _parts(x)
    if "axes" in static:
        static["axes"] = tuple([_numbers(axis) for axis in static["axes"]])
    return list(nodes.values()), (tuple(nodes), static)


def _numbers(axis: Axis) -> tuple[Any, ...]:
    """Parameters that define an axis. Numbers in a slice become constants in torch.compile."""
    return axis.name, axis.unit, slice(axis.n, axis.start, axis.step), slice(axis.dual_start)


def _flatten_with_keys(x: Any) -> tuple[list[tuple[Any, Any]], _Structure]:
    nodes, structure = _flatten(x)
    return [(pytree.GetAttrKey(name), node) for name, node in zip(structure[0], nodes)], structure


def _unflatten(kind: type, nodes: Iterable[Any], structure: _Structure) -> Any:
    """Rebuild an object from its tensors and its structure.

    torch also builds such trees of other leaves, such as the numbers of `in_dims`. The constructor
    would raise an error for them; therefore the object then only stores the leaves and the
    structure.
    """
    names, static = structure
    whole, nodes = dict(static), list(nodes)
    if "axes" in whole:
        whole["axes"] = tuple(
            [Axis(name, grid.start, grid.stop, grid.step, unit, dual.stop) for name, unit, grid, dual in whole["axes"]]
        )
    for name, value in zip(names, nodes):
        whole[name] = {**value, **whole[name]} if name in whole else value
    if all(map(_holds_tensors, nodes)):
        return kind(**whole)
    bare = object.__new__(kind)
    vars(bare).update(whole, **{_BARE: (nodes, structure)})
    return bare


def _holds_tensors(node: Any) -> bool:
    """True if all leaves of a tree are tensors."""
    if isinstance(node, dict):
        return all(map(_holds_tensors, node.values()))
    return isinstance(node, Tensor) or (isinstance(node, _NODES) and _BARE not in vars(node))


def _collate(batch: Sequence[Any], *, collate_fn_map: dict[Any, Callable[..., Any]] | None = None) -> Any:
    """Stack the tensors of several samples along a new leading trial dimension."""
    leaves, structures = zip(*(pytree.tree_flatten(sample) for sample in batch))
    odd = next((i for i, one in enumerate(structures) if one != structures[0]), None)
    if odd is not None:
        raise ValueError(
            f"a batch needs {type(batch[0]).__name__}s of equal axes, radar and names, but the samples 0 and {odd} "
            f"differ in {_difference(batch[0], batch[odd])}; crop or pad the samples to one shape, or pass a "
            "collate_fn to the DataLoader"
        )
    stacked = [collate(tensors, collate_fn_map=collate_fn_map) for tensors in zip(*leaves)]
    return pytree.tree_unflatten(stacked, structures[0])


def _difference(one: Any, other: Any) -> str:
    """Describe the first part of the structure in which two objects differ, with both values."""
    (nodes, static), (others, other_static) = _parts(one), _parts(other)
    for name, value in static.items():
        if value != other_static.get(name):
            return f"{name}: {value} and {other_static.get(name)}"
    for name, value in nodes.items():
        if isinstance(value, dict) and list(value) != list(others[name]):
            return f"the names in {name}: {list(value)} and {list(others[name])}"
        if isinstance(value, (Signal, Recording)) and pytree.tree_structure(value) != pytree.tree_structure(
            others[name]
        ):
            return f"{name}.{_difference(value, others[name])}"
    return "the fields that hold tensors"


for _kind in (Signal, Recording, Truth, Estimate):
    pytree.register_pytree_node(
        _kind,
        _flatten,
        partial(_unflatten, _kind),
        serialized_type_name=f"torchsar.{_kind.__name__}",
        flatten_with_keys_fn=_flatten_with_keys,
    )
    default_collate_fn_map[_kind] = _collate
