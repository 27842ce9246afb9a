"""What results depend on: digests of functions and their values, of packages and of files."""

from __future__ import annotations

import argparse
import copyreg
import hashlib
import json
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path
from types import (
    CellType,
    CodeType,
    FunctionType,
    GetSetDescriptorType,
    MappingProxyType,
    MemberDescriptorType,
    ModuleType,
    SimpleNamespace,
)
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from torchsar.study.settings.errors import ConfigError, is_library

# largest number of characters in a description of a value; a longer one is replaced by a digest
_SHOWN = 40
_PLAIN = (type(None), bool, int, float, complex, str, bytes, type(Ellipsis))
# kinds of objects of which only the members that the code names are described
_NAMESPACES = (ModuleType, argparse.Namespace, SimpleNamespace)


def fingerprint(function: Callable[..., Any]) -> dict[str, Any]:
    """Describe a function such that the description changes with its results.

    The description covers the bytecode, constants and names of the function and of functions inside
    it, its defaults and the values that it closes over. It also covers the state of a callable
    object, and the global names that the function uses, among them other functions of the user with
    all that they use. Functions of installed packages and of the standard library are represented
    by their names. Line numbers, comments and the docstring do not change the description. Another
    version of Python may give another description.

    Args:
        function: A function, a method, a `functools.partial`, or an object with `__call__`.

    Returns:
        `name`, the qualified name; `code`, a digest of code and defaults. And `uses`, a description
        of each value that the function closes over, reads from a global name, or holds as an
        attribute: a short text, or a digest of a longer one.

    Raises:
        ConfigError: If a value that the function uses has no description, such as an open file.
    """
    reader, plain, uses = _Reader(), isinstance(function, FunctionType), {}
    for key, value in sorted((_used(function) if plain else {"object": function}).items()):
        try:
            text = reader.text(value)
        except Exception as error:  # locks, files and generators raise errors of many kinds
            raise ConfigError(
                f"sweep: {name_of(function)} uses {key}, whose value cannot be compared with that of a later run "
                f"({error}); give a version, which counts instead"
            ) from None
        uses[key] = text if len(text) <= _SHOWN else f"{text.partition('(')[0]} {_digest(text)}"
    return {"name": name_of(function), "code": _digest(reader.text(_own(function)) if plain else ""), "uses": uses}


def name_of(function: Callable[..., Any]) -> str:
    """The qualified name of a function, or that of the class of another callable object."""
    return getattr(function, "__qualname__", type(function).__qualname__)


def packages_of(modules: Iterable[nn.Module]) -> set[str]:
    """Return the packages of modules, and of the modules inside them, that belong to the user."""
    tops = {type(part).__module__.partition(".")[0] for module in modules for part in module.modules()}
    return tops - {"torch", "torchsar"}


def code(packages: Iterable[str] = ()) -> dict[str, Any]:
    """Describe the programs that results depend on besides the trial function.

    Args:
        packages: Further packages or modules, such as those of the user's stages.

    Returns:
        `code`, a digest of all files of torchsar and of each of the packages by its name; and
        `versions`, those of torch and numpy. A package without files, such as one in an archive,
        counts by its name.
    """
    digests = {top: _digest(b"\0".join(_files(top))) for top in sorted({"torchsar", *packages})}
    return {"code": digests, "versions": {"torch": torch.__version__, "numpy": np.__version__}}


def _files(top: str) -> Iterator[bytes]:
    """The names and contents of the source files of a package or module, loaded or not."""
    spec = None if top in sys.modules else find_spec(top)
    here = sys.modules.get(top, SimpleNamespace())
    folders = getattr(here, "__path__", None) or (spec and spec.submodule_search_locations) or ()
    files = [(Path(folder), file) for folder in folders for file in sorted(Path(folder).rglob("*.py"))]
    alone = Path(getattr(here, "__file__", None) or (spec and spec.origin) or "")
    for folder, file in files or [(alone.parent, alone)]:
        if file.is_file():
            yield file.relative_to(folder).as_posix().encode()
            yield file.read_bytes()


def files_in(tree: Any) -> dict[str, str]:
    """Return digests of the contents of all files that a config names, by their path."""
    if isinstance(tree, Mapping):
        tree = list(tree.values())
    if isinstance(tree, list):
        return {path: digest for value in tree for path, digest in files_in(value).items()}
    named = isinstance(tree, str) and 0 < len(tree) < 4096 and "\0" not in tree
    return {tree: _digest(Path(tree).read_bytes())} if named and os.path.isfile(tree) else {}


def changes(was: Any, now: Any, where: str = "") -> Iterator[str]:
    """Yield what differs between two trees: the path, the earlier and the later value, as words."""
    if isinstance(was, Mapping) and isinstance(now, Mapping):
        for key in dict.fromkeys((*was, *now)):
            name = f"{where}.{key}" if where else str(key)
            yield from changes(was.get(key, "absent"), now.get(key, "absent"), name)
    elif was != now:
        yield f"{where} was {short(was)} and is {short(now)}"


def short(value: Any) -> str:
    """Return a value as a text of at most 60 characters."""
    text = value if isinstance(value, str) else json.dumps(value).removesuffix(".0")
    return text if len(text) <= 60 else text[:57] + "..."


class _Reader:
    """Writer of values as texts, which are equal in any process for values of equal effect."""

    def __init__(self) -> None:
        self._known: dict[int, tuple[Any, str]] = {}
        self._open: list[int] = []

    def text(self, value: Any) -> str:
        """Text of any value. Where a value contains itself, its text has a reference to the outer
        value.
        """
        if type(value) in _PLAIN:
            return f"{type(value).__name__} {value!r}"
        if id(value) in self._open:
            return f"outer {len(self._open) - self._open.index(id(value))}"
        if id(value) not in self._known:
            self._open.append(id(value))
            kind = value.__qualname__ if isinstance(value, type) else self.text(type(value)).partition("(")[0]
            text = f"{kind}({', '.join(map(self.text, self._parts(value)))})"
            self._open.pop()
            # the value is kept, so that its id is not used for another one
            self._known[id(value)] = value, text
        return self._known[id(value)][1]

    def _parts(self, value: Any) -> Iterable[Any]:
        """All parts that determine a value."""
        if isinstance(value, FunctionType):
            return (_own(value), _used(value))
        if isinstance(value, CodeType):
            return _parts_of_code(value)
        if isinstance(value, (type, ModuleType)):
            return _parts_of_name(value)
        strided = isinstance(value, Tensor) and value.layout is torch.strided
        if strided or (isinstance(value, np.ndarray) and not value.dtype.hasobject):
            return (str(value.dtype), tuple(value.shape), _digest(_content(value)))
        if isinstance(value, (list, tuple)):
            return value
        if isinstance(value, (set, frozenset)):
            return sorted(value, key=self.text)
        if type(value) is dict or isinstance(value, MappingProxyType):
            return sorted(value.items(), key=self.text)
        if isinstance(value, (staticmethod, classmethod, property, cached_property)):
            return [getattr(value, name, None) for name in ("__func__", "fget", "fset", "func")]
        # slots and other attributes implemented in C are described by their names
        if isinstance(value, (GetSetDescriptorType, MemberDescriptorType)):
            return (value.__qualname__,)
        # functions registered with copyreg take precedence over the method of the object, as in
        # pickle
        pickler = copyreg.dispatch_table.get(type(value))
        reduced = pickler(value) if pickler else value.__reduce_ex__(4)
        pickled = [reduced] if isinstance(reduced, str) else reduced
        parts = [list(part) if isinstance(part, Iterator) else part for part in pickled]
        return [type(value), *parts, getattr(value, "__wrapped__", None)]


def _own(function: FunctionType) -> list[Any]:
    """Code of a function, or its name if it belongs to a library, and its defaults."""
    module = str(function.__globals__.get("__name__"))
    code = f"{module}.{function.__code__.co_qualname}" if is_library(module) else function.__code__
    return [code, function.__defaults__, function.__kwdefaults__]


def _used(function: FunctionType) -> dict[str, Any]:
    """Values that a function closes over, and values of the global names that it mentions."""
    cells = zip(function.__code__.co_freevars, function.__closure__ or ())
    # None if the variable is not assigned
    found = {name: None if cell == CellType() else cell.cell_contents for name, cell in cells}
    scope, mentioned = function.__globals__, _names(function.__code__)
    for name in () if is_library(str(scope.get("__name__"))) else sorted(mentioned & set(scope)):
        value = scope[name]
        if not isinstance(value, _NAMESPACES):
            found[name] = value
        elif not (isinstance(value, ModuleType) and is_library(value.__name__)):
            found |= {f"{name}.{key}": vars(value)[key] for key in mentioned & set(vars(value))}
    return found


def _names(code: CodeType) -> set[str]:
    """All names that a code object mentions, including those of inner functions."""
    inner = [_names(one) for one in code.co_consts if isinstance(one, CodeType)]
    return set(code.co_names).union(*inner)


def _parts_of_code(code: CodeType) -> tuple[Any, ...]:
    constants = code.co_consts
    # the first constant of a function is its docstring, or None if it has no docstring
    if constants and isinstance(constants[0], str) and code.co_name not in ("<lambda>", "<module>"):
        constants = (None, *constants[1:])
    parts = "code exceptiontable argcount posonlyargcount kwonlyargcount flags names varnames freevars cellvars"
    return constants, *(getattr(code, f"co_{part}") for part in parts.split())


def _parts_of_name(value: type | ModuleType) -> tuple[Any, ...]:
    """Name of a class or a module. For a class of the user also its bases and its members, without
    those that Python adds.
    """
    if isinstance(value, ModuleType) or is_library(value.__module__):
        return (getattr(value, "__module__", ""), value.__name__)
    members = {
        key: one
        for key, one in vars(value).items()
        if isinstance(one, FunctionType) or not key.startswith(("__", "_abc"))
    }
    return (value.__module__, value.__name__, value.__bases__, members)


def _content(x: Tensor | np.ndarray) -> bytes:
    """Bytes of all numbers of an array."""
    if isinstance(x, Tensor):
        plain = x.detach().cpu().resolve_conj().resolve_neg().contiguous().reshape(-1)
        return plain.view(torch.uint8).numpy().tobytes() if plain.numel() else b""
    return x.tobytes()


def _digest(content: str | bytes) -> str:
    data = content.encode("utf-8", "surrogatepass") if isinstance(content, str) else content
    return hashlib.blake2b(data, digest_size=8).hexdigest()
