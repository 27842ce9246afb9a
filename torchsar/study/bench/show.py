"""Tables and figures of records of benchmarks."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchsar.study.bench.records import Record, write
from torchsar.study.settings.errors import ConfigError

# key, heading, factor and format of the columns of a table
COLUMNS = (
    ("merit", "merit", 1.0, ".2f"),
    ("right", "right %", 100.0, ".0f"),
    ("sure_wrong", "sure and wrong %", 100.0, ".1f"),
    ("needless", "needless doubt %", 100.0, ".0f"),
    ("over_bound", "error / bound", 1.0, ".2f"),
    ("image_error_db", "image error dB", 1.0, ".1f"),
    ("sharper_wrong", "sharper, wrong %", 100.0, ".0f"),
    ("calibration", "error / std", 1.0, ".2f"),
    ("pairs", "transforms", 1.0, ".0f"),
    ("memory", "memory", 1.0, ".0f"),
)


LEAK = "below the bound: check for a leak of the truth"


def ranked(record: Record) -> list[tuple[str, dict[str, Any]]]:
    """Names and sums of the methods, those of the greatest merit first.

    Those far below the bound, which no method without bias can be, have no merit and are the last.
    """
    rows = [(name, method["all"] | {"memory": method.get("memory")}) for name, method in record["methods"].items()]
    rows = sorted(rows, key=lambda pair: -pair[1]["merit"][0])
    honest = [(name, row) for name, row in rows if not _leaks(row)]
    return honest + [(f"{name} *", row | {"merit": [None] * 3}) for name, row in rows if _leaks(row)]


def _leaks(row: dict[str, Any], least: float = 0.5) -> bool:
    # the median of a method at the bound is 1 within some percent
    median = row.get("over_bound", [None])[0]
    return median is not None and median < least


def cells(record: Record) -> list[list[str]]:
    """Texts of a table: the headings, and a line for each method with 95 % intervals."""
    rows = ranked(record)
    shown = [column for column in COLUMNS if any(numbers.get(column[0]) is not None for _, numbers in rows)]
    lines = [["method", *(heading for _, heading, *_ in shown)]]
    for name, numbers in rows:
        lines.append([name, *(_text(numbers.get(key), factor, form) for key, _, factor, form in shown)])
    return lines


def _text(value: Any, factor: float, form: str) -> str:
    first, *ends = value if isinstance(value, list) else [value]
    if first is None:
        return "-"
    text = format(factor * first, form)
    return text if None in ends or not ends else f"{text} ({' to '.join(format(factor * end, form) for end in ends)})"


def about(record: Record) -> str:
    """Name, version and size of a record, as it is cited."""
    trials = max(method["all"]["trials"] for method in record["methods"].values())
    worlds = max(len(method["worlds"]) for method in record["methods"].values())
    other = f", draw {record['draw']}" if record["draw"] else ""
    small = ", reduced" if record["small"] else ""
    leaks = any(_leaks(method["all"]) for method in record["methods"].values())
    return (
        f"torchsar bench {record['bench']}, version {record['version']}, checksum {record['checksum']}: "
        f"{worlds} worlds, {trials} trials{small}{other}"
        f"{f'; * {LEAK}' if leaks else ''}"
    )


def table(record: Record, ends: bool = False) -> str:
    """Text of a table of all methods, with the intervals of the values if `ends`."""
    return aligned(
        about(record), [[cell if ends else cell.partition(" (")[0] for cell in line] for line in cells(record)]
    )


def aligned(title: str, lines: Sequence[Sequence[str]]) -> str:
    """Text of a title and of cells in columns."""
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    padded = ([line[0].ljust(widths[0]), *map(str.rjust, line[1:], widths[1:])] for line in lines)
    return "\n".join([title, *map("  ".join, padded)])


def latex(record: Record) -> str:
    """Table in LaTeX, whose caption cites the version and the checksum."""
    head, *lines = [[_escaped(cell) for cell in line] for line in cells(record)]
    rows = [" & ".join(line) + r" \\" for line in lines]
    columns = "l" + "r" * (len(head) - 1)
    caption = f"{about(record)}. Intervals of 95 \\% in parentheses."
    top = [r"\begin{table}", rf"\caption{{{_escaped(caption)}}}", rf"\begin{{tabular}}{{{columns}}}", r"\hline"]
    return "\n".join(
        [*top, " & ".join(head) + r" \\", r"\hline", *rows, r"\hline", r"\end{tabular}", r"\end{table}", ""]
    )


def _escaped(text: str) -> str:
    for letter in "%_&":
        text = text.replace(f"\\{letter}", letter).replace(letter, f"\\{letter}")
    return text


def figure(record: Record) -> Any:
    """Figure of the merit and of the share that is sure and wrong, with 95 % intervals."""
    from torchsar import plot

    rows = ranked(record)
    labels = {"merit": "mean merit", "right": "share right", "sure_wrong": "share sure and wrong"}
    series = {label: np.array([row[key] for _, row in rows], dtype=float) for key, label in labels.items()}
    return plot.marks([name for name, _ in rows], series, "of all trials, with 95 % intervals", about(record))


def new_files(files: Sequence[Path]) -> None:
    """Refuse names of files that exist, or end in what is not written."""
    for path in files:
        if path.suffix not in (".json", ".tex", ".txt", ".pdf", ".png", ".svg"):
            raise ConfigError(f"--out {path}: the name must end in .json, .tex, .txt, .pdf, .png or .svg")
        if path.exists():
            raise ConfigError(f"--out {path}: the file exists; give another name, or move it away")


def save(record: Record, files: Sequence[Path | str]) -> None:
    """Write a record (.json), its table (.tex, .txt) or its figure (.pdf, .png, .svg)."""
    for path in map(Path, files):
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix == ".json":
            write(path, record)
        elif path.suffix in (".tex", ".txt"):
            path.write_text(
                latex(record) if path.suffix == ".tex" else f"{table(record, ends=True)}\n", encoding="utf-8"
            )
        else:
            from torchsar import plot

            plot.save(figure(record), path)
