"""What a prompt and a notebook show of an object: a line of text or tables, not all its numbers."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from html import escape
from typing import Any

from torch import Tensor

Rows = Sequence[Sequence[str]]
# largest length of a text in one line; each part of a longer text has its own line
_LINE = 100
# no style sets a colour, so that pages with a light and with a dark background are readable
_LEFT = 'style="text-align:left"'


@dataclass(frozen=True)
class Summary:
    """Description of an object.

    Args:
        about: The object as a whole, in a few words.
        tables: Rows of words by heading; the first word of a row names a part of the object.
    """

    about: str
    tables: Mapping[str, Rows] = field(default_factory=dict)

    def text(self, kind: str) -> str:
        """Return the description as text.

        Args:
            kind: Name of the class of the object.

        Returns:
            One line, or if it were too long, one line per row.
        """
        parts = [self.about, *(_joined(row) for rows in self.tables.values() for row in rows)]
        line = f"{kind}({'; '.join(parts)})"
        return line if len(line) <= _LINE else "\n  ".join([f"{kind}({parts[0]}", *parts[1:]]) + ")"

    def html(self, kind: str) -> str:
        """Return the description as HTML without scripts, colours and external resources.

        Args:
            kind: Name of the class of the object.

        Returns:
            One `div` element.
        """
        tables = "".join(_table(heading, rows) for heading, rows in self.tables.items() if rows)
        return f"<div><strong>{escape(kind)}</strong> {escape(self.about)}{tables}</div>"


class Shown:
    """Base of the classes whose objects a prompt and a notebook show by a summary."""

    def _summary(self) -> Summary:
        """Describe the object, without a computation with its samples."""
        raise NotImplementedError(f"{type(self).__name__} has no summary")

    def __repr__(self) -> str:
        return self._summary().text(type(self).__name__)

    def _repr_html_(self) -> str:
        return self._summary().html(type(self).__name__)


def kind_of(x: Tensor) -> str:
    """Return dtype and shape of a tensor as words.

    Args:
        x: Tensor of any kind; its values are not read.

    Returns:
        Words such as "complex64 (4, 1000)".
    """
    return f"{str(x.dtype).removeprefix('torch.')} {tuple(x.shape)}"


def content(x: object) -> str:
    """Return a number, or the kind of a tensor that does not hold exactly one, as words.

    Args:
        x: Tensor or another object.

    Returns:
        The number with six digits, dtype and shape of the tensor, or the class of the object.
    """
    if not isinstance(x, Tensor):
        return f"{x:.6g}" if isinstance(x, float) else type(x).__name__
    number = one_number(x) if x.numel() == 1 else None
    return kind_of(x) if number is None else f"{number:.6g}"


def argument(x: object) -> str:
    """Return an argument of a call as words: itself if it is short and plain, otherwise its kind.

    Args:
        x: Any object.

    Returns:
        Words such as "3", "'hann'" or "float64 (4,)".
    """
    plain = isinstance(x, (bool, int, str, bytes, tuple, list, dict)) or x is None
    return repr(x) if plain and len(repr(x)) <= 40 else content(x)


def show_briefly(members: Iterable[object]) -> None:
    """Let objects of the dataclasses of a package show their tensors by dtype and shape.

    Args:
        members: Members of a package; those that are no dataclasses are left as they are.
    """

    def brief(self: Any) -> str:
        named = ", ".join(f"{one.name}={argument(getattr(self, one.name))}" for one in fields(self) if one.repr)
        return f"{type(self).__name__}({named})"

    for one in members:
        if isinstance(one, type) and is_dataclass(one) and one.__repr__ is not Shown.__repr__:
            one.__repr__ = brief


def one_number(x: Tensor) -> complex | None:
    """Return the number in a tensor.

    Args:
        x: Tensor of one element.

    Returns:
        The number; None where it cannot be read, as within `torch.func.vmap`.
    """
    try:
        return x.item()
    except RuntimeError:
        return None


def in_bytes(count: float) -> str:
    """Return a size as words.

    Args:
        count: Number of bytes.

    Returns:
        Words such as "6.3 MB".
    """
    for unit in ("bytes", "kB", "MB", "GB"):
        if count < 1000:
            break
        count, unit = count / 1000, "TB"
    return f"{count:.3g} {unit}"


def some_of(values: Sequence[float | str]) -> str:
    """Return numbers or names as words.

    Args:
        values: Numbers or names in their order, at least one.

    Returns:
        All of up to four, such as "0, 5, 10", and of more only the first and the last.
    """
    words = [x if isinstance(x, str) else f"{x:.6g}" for x in values]
    return f"{words[0]} to {words[-1]}" if len(words) > 4 else ", ".join(words)


def _joined(row: Sequence[str]) -> str:
    words = ", ".join(filter(None, row[1:]))
    return f"{row[0]}: {words}" if words else row[0]


def _table(heading: str, rows: Rows) -> str:
    """Make an HTML table of rows, without empty columns."""
    width = max(map(len, rows))
    full = [[*row, *[""] * (width - len(row))] for row in rows]
    kept = [i for i in range(width) if any(row[i] for row in full)]
    head = f'<tr><th colspan="{len(kept)}" {_LEFT}>{escape(heading)}</th></tr>'
    body = (f"<tr>{''.join(f'<td {_LEFT}>{escape(row[i])}</td>' for i in kept)}</tr>" for row in full)
    return f"<table>{head}{''.join(body)}</table>"
