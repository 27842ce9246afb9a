"""Fingerprints of functions and modules: digests of their code and of all values that it uses."""

from __future__ import annotations

import argparse
import dis
import functools
import hashlib
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from operator import itemgetter
from pathlib import Path
from types import CodeType, FunctionType, MethodType, ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

# packages whose functions are known by name, beside the standard library and installed packages
_LIBRARIES = ("torchsar", "torch", "numpy")
_INSTALLED = ("site-packages", "dist-packages")
# longer descriptions of values are replaced by a digest
_SHOWN = 40
_PLAIN = (type(None), bool, int, float, complex, str, bytes, type(Ellipsis), range, slice)
# of these objects only those members count that the code names
_NAMESPACES = (ModuleType, argparse.Namespace, SimpleNamespace)
# entries of a class that change no result
_UNSEEN = (
    *("__doc__", "__dict__", "__weakref__", "__module__", "__qualname__", "__slotnames__"),
    *("__firstlineno__", "__static_attributes__", "__annotations__", "__annotate_func__", "__annotations_cache__"),
)
_GLOBAL = ("LOAD_GLOBAL", "LOAD_NAME")


def fingerprint(function: Callable[..., Any]) -> dict[str, Any]:
    """Describe a function such that the description changes with its results.

    The description covers the bytecode, constants and names of the function and of functions
    inside it, its defaults, the values that it closes over, the state of a callable object, and the
    global names that it uses, among them other functions of the user with all that they use.
    Functions of installed packages and of the standard library count by name. Line numbers,
    comments and the docstring do not count. Another version of Python may give another description.

    Args:
        function: A function, a method, a `functools.partial`, or an object with `__call__`.

    Returns:
        `name`, the qualified name; `code`, a digest of code and defaults; and `uses`, a description
        of each value that the function closes over, reads from a global name, or holds as an
        attribute: a short text, or a digest of a longer one.
    """
    reader = _Reader()
    if isinstance(function, FunctionType):
        code, used = reader.own(function), reader.used(function)
    else:
        code, used = "", dict(_state_of(function))
    name = getattr(function, "__qualname__", type(function).__qualname__)
    kind = reader.text(function if isinstance(function, (FunctionType, type)) else type(function))
    uses = {name: _short(reader.text(value)) for name, value in sorted(used.items())}
    return {"name": name, "code": _digest(code or kind), "uses": uses}


def own_code(modules: Iterable[nn.Module]) -> dict[str, str]:
    """Describe the code of modules that do not belong to this library, such as stages of the user.

    Args:
        modules: Modules. Those inside them count as well.

    Returns:
        A digest of all source files by the name of the package. A package without source files,
        such as one in an archive, counts by its name. Empty if all modules belong to torchsar or
        torch.
    """
    tops = {type(part).__module__.partition(".")[0] for module in modules for part in module.modules()}
    found = {}
    for top in sorted(tops - {"torchsar", "torch"}):
        here = sys.modules.get(top)  # none if it was loaded in another way
        files = [file for folder in getattr(here, "__path__", ()) for file in sorted(Path(folder).rglob("*.py"))]
        files = files or [Path(getattr(here, "__file__", None) or "")]
        texts = [file.name.encode() + file.read_bytes() for file in files if file.is_file()]
        found[top] = _digest(b"\0".join(texts))
    return found


class _Reader:
    """Writes values as texts that are equal for values of equal effect, in whatever process."""

    def __init__(self) -> None:
        self._known: dict[int, tuple[Any, str]] = {}
        self._open: list[int] = []

    def text(self, value: Any) -> str:
        """The text of any value; values that contain themselves end in a reference."""
        if isinstance(value, _PLAIN) and type(value) in _PLAIN:
            return f"{type(value).__name__} {value!r}"
        if id(value) in self._open:
            return f"outer {len(self._open) - self._open.index(id(value))}"
        if id(value) not in self._known:
            self._open.append(id(value))
            text = self._of(value)
            self._open.pop()
            self._known[id(value)] = value, text  # the value is kept, and with it its id
        return self._known[id(value)][1]

    def _of(self, value: Any) -> str:
        if isinstance(value, FunctionType):
            return f"function {self.own(value)} {self.text(self.used(value))}"
        if isinstance(value, CodeType):
            return self._code(value)
        if isinstance(value, type):
            return self._class(value)
        if isinstance(value, ModuleType):
            return f"module {value.__name__}"
        if isinstance(value, Tensor):
            return _of_tensor(value)
        if isinstance(value, np.ndarray) and not value.dtype.hasobject:
            return f"array {value.dtype} {value.shape} {_digest(value.tobytes())}"
        if isinstance(value, (staticmethod, classmethod)):
            return f"{type(value).__name__} {self.text(value.__func__)}"
        if isinstance(value, property):
            return f"property {self.text([value.fget, value.fset])}"
        if type(value) in (list, tuple):
            return f"{type(value).__name__}({', '.join(map(self.text, value))})"
        if type(value) in (set, frozenset):
            return f"{type(value).__name__}({', '.join(sorted(map(self.text, value)))})"
        if type(value) is dict:
            items = sorted(((self.text(key), one) for key, one in value.items()), key=itemgetter(0))
            return f"dict({', '.join(f'{key}: {self.text(one)}' for key, one in items)})"
        return f"{self.text(type(value))} {self.text(dict(_state_of(value)))}"

    def own(self, function: FunctionType) -> str:
        """The text of the code of a function and of its defaults; of a library, its name."""
        module = str(function.__globals__.get("__name__"))
        code = f"{module}.{function.__code__.co_qualname}" if _is_library(module) else self._code(function.__code__)
        return f"{code} {self.text([function.__defaults__, function.__kwdefaults__])}"

    def used(self, function: FunctionType) -> dict[str, Any]:
        """The values that a function closes over and those of the global names that it reads."""
        found: dict[str, Any] = {}
        for name, cell in zip(function.__code__.co_freevars, function.__closure__ or ()):
            try:
                found[name] = cell.cell_contents
            except ValueError:  # a name without a value yet
                found[name] = None
        scope = function.__globals__
        if _is_library(str(scope.get("__name__"))):
            return found
        read, mentioned = _names(function.__code__)
        for name in sorted(read & set(scope)):
            value = scope[name]
            if not isinstance(value, _NAMESPACES):
                found[name] = value
            elif not (isinstance(value, ModuleType) and _is_library(value.__name__)):
                found.update({f"{name}.{key}": vars(value)[key] for key in sorted(mentioned & set(vars(value)))})
        return found

    def _code(self, code: CodeType) -> str:
        constants = code.co_consts
        # the docstring of a function is its first constant, which is None without one
        if constants and isinstance(constants[0], str) and code.co_name not in ("<lambda>", "<module>"):
            constants = (None, *constants[1:])
        counts = (code.co_argcount, code.co_posonlyargcount, code.co_kwonlyargcount, code.co_flags)
        names = (code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars)
        return _digest(self.text([code.co_code, code.co_exceptiontable, list(constants), counts, names]))

    def _class(self, kind: type) -> str:
        name = f"class {kind.__module__}.{kind.__qualname__}"
        if _is_library(kind.__module__):
            return name
        members = {key: value for key, value in vars(kind).items() if key not in _UNSEEN and not key.startswith("_abc")}
        return f"{name} {self.text([*kind.__bases__])} {self.text(members)}"


def _names(code: CodeType) -> tuple[set[str], set[str]]:
    """The global names that code reads, and all names that it mentions, also in inner functions."""
    read = {str(step.argval) for step in dis.get_instructions(code) if step.opname in _GLOBAL}
    mentioned = set(code.co_names)
    for inner in (one for one in code.co_consts if isinstance(one, CodeType)):
        more = _names(inner)
        read, mentioned = read | more[0], mentioned | more[1]
    return read, mentioned


def _state_of(value: Any) -> Iterator[tuple[str, Any]]:
    """Name and value of each part of an object, as it would be pickled; none if it cannot be."""
    if isinstance(value, MethodType):
        yield from (("function", value.__func__), ("self", value.__self__))
        return
    if isinstance(value, functools.partial):
        yield from (("function", value.func), ("args", list(value.args)), *value.keywords.items())
        return
    if hasattr(value, "__wrapped__"):
        yield "wrapped", value.__wrapped__
    try:
        reduced = value.__reduce_ex__(2)
    except Exception:  # locks, files and generators refuse with errors of many kinds
        return
    made, state = (reduced, None) if isinstance(reduced, str) else (reduced[:2], (*reduced, None)[2])
    pairs = reduced[3:5] if not isinstance(reduced, str) else ()
    items = [list(one) for one in pairs if one is not None]
    yield from (("made by", made), *([("items", items)] if items else []))
    yield from state.items() if isinstance(state, Mapping) else [("state", state)]


def _is_library(module: str) -> bool:
    """Whether a module belongs to the standard library or to an installed package."""
    top = module.partition(".")[0]
    if top in sys.stdlib_module_names or top in _LIBRARIES:
        return True
    file = getattr(sys.modules.get(module), "__file__", None) or ""
    return any(folder in file for folder in _INSTALLED)


def _of_tensor(x: Tensor) -> str:
    plain = x.detach().cpu().resolve_conj().resolve_neg().contiguous().reshape(-1)
    content = plain.view(torch.uint8).numpy().tobytes() if plain.numel() else b""
    return f"tensor {x.dtype} {tuple(x.shape)} {_digest(content)}"


def _short(text: str) -> str:
    return text if len(text) <= _SHOWN else f"{text.partition(' ')[0]} {_digest(text)}"


def _digest(content: str | bytes) -> str:
    data = content.encode("utf-8", "surrogatepass") if isinstance(content, str) else content
    return hashlib.blake2b(data, digest_size=8).hexdigest()
