"""Figures and tables from the records of `torchsar bench` and in docs/sweeps, docs/trade,
docs/benchmark, docs/requires and docs/reproduce.

A page names a record, what to show of it, and its words; every number comes from the record.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from docutils import nodes
from docutils.parsers.rst import directives
from matplotlib import rc_context
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from torchsar import plot
from torchsar.reproduce.item import SHOWN
from torchsar.study.bench import recorded, show
from torchsar.study.bench.records import HERE
from torchsar.study.trials.choice import EXACT_DB

# the order of the systems in tables
SYSTEMS = ("stripmap", "isal", "isal_rotation", "sal", "geo", "geo_ocean", "path")


def pairs(text: str) -> dict[str, str]:
    """Words by name, from "name = words; name = words"."""
    found = (part.split("=", 1) for part in text.split(";") if part.strip())
    return {name.strip(): words.strip() for name, words in found}


def short(value: float | None) -> str:
    """A number to three digits."""
    if value is None or not math.isfinite(value):
        return "-"
    return f"{value:.3g}" if 1e-4 <= abs(value) < 1e5 or value == 0 else f"{value:.2e}"


def cell(value: float | None) -> str:
    """A number to three digits, with zeros in place of an exponent, and thousands apart."""
    if value is None or not math.isfinite(value):
        return "-"
    rounded = float(f"{value:.3g}")
    return f"{rounded:,.0f}" if abs(rounded) >= 1e4 else np.format_float_positional(rounded, trim="-")


def read(directive: SphinxDirective, folder: str, name: str) -> dict[str, Any]:
    """A record, on which the page of the directive then depends."""
    path = Path(directive.env.srcdir) / folder / f"{name}.json"
    directive.env.note_dependency(str(path))
    return json.loads(path.read_text(encoding="utf-8"))


# statistics of a record, and how a caption names them
STATISTICS = {"median": "Medians", "rmse": "RMS values", "success_share": "Shares"}


@dataclass(frozen=True)
class Curve:
    """Values of one algorithm or bound over the parameter, with confidence intervals."""

    values: list[float]
    intervals: list[tuple[float, float]]


class Sweep(SphinxDirective):
    """What a figure and a table of a sweep share: the record and what is shown of it."""

    required_arguments = 1
    has_content = True
    option_spec = {
        "metric": directives.unchanged_required,
        "of": lambda word: directives.choice(word, tuple(STATISTICS)),
        "x": directives.unchanged_required,
        "xlabel": directives.unchanged_required,
        "ylabel": directives.unchanged_required,
        "where": pairs,
        "show": pairs,
        "bounds": pairs,
        "scale": float,
        "title": directives.unchanged,
        "log-x": directives.flag,
    }

    def record(self) -> dict[str, Any]:
        """The record, on which the page depends."""
        return read(self, "sweeps", self.arguments[0])

    def fits(self, parameters: Mapping[str, Any]) -> bool:
        """Whether a point of the grid is one of those that are shown."""
        return all(str(parameters[key]) == value for key, value in self.options.get("where", {}).items())

    def chosen(self) -> tuple[list[Any], dict[str, Curve], dict[str, Curve]]:
        """Values of the parameter, and curves of algorithms and of bounds over them, by label."""
        record, x, scale = self.record(), self.options["x"], self.options.get("scale", 1.0)
        of = self.options.get("of", "rmse")
        rows = [p for p in record["points"] if p["metric"] == self.options["metric"] and self.fits(p["parameters"])]
        lower = [b for b in record["bounds"] if b["metric"] == self.options["metric"] and self.fits(b["parameters"])]
        values = list(dict.fromkeys(row["parameters"][x] for row in rows))
        curves = {}
        for name, label in self.options["show"].items():
            at = {row["parameters"][x]: row for row in rows if row["algorithm"] == name}
            if not at:
                raise self.error(f"{self.arguments[0]}.json has no {self.options['metric']} of {name!r}")
            found = [scale * at[value][of] if value in at else math.nan for value in values]
            nothing = (math.nan, math.nan)  # no interval, as of a median
            given = [at[value]["interval"] if value in at and of == "rmse" else nothing for value in values]
            ends = [(scale * low, scale * high) for low, high in given]
            curves[label] = Curve(found, ends)
        bounds = {}
        for name, label in self.options.get("bounds", {}).items():
            at = {bound["parameters"].get(x): bound["rms"] for bound in lower if bound["bound"] == name}
            if not at:
                raise self.error(f"{self.arguments[0]}.json has no bound {name!r} of {self.options['metric']}")
            found = [scale * at[value] if value in at else math.nan for value in values]
            bounds[label] = Curve(found, [])
        return values, curves, bounds

    def origin(self) -> str:
        """Where the numbers come from, as the end of a caption."""
        of, trials = STATISTICS[self.options.get("of", "rmse")], self.record()["made_with"]["trials"]
        return f"{of} over {trials} trials; record: `docs/sweeps/{self.arguments[0]}.json`."

    def caption(self) -> list[nodes.Node]:
        """The words of the page and the origin of the numbers, as inline nodes."""
        text = " ".join(self.content) + " " + self.origin()
        parsed = self.parse_text_to_nodes(text.strip())
        return list(parsed[0].children)


class SweepFigure(Sweep):
    """Draw errors over one parameter of a recorded sweep, with bounds."""

    def run(self) -> list[nodes.Node]:
        values, curves, bounds = self.chosen()
        part = {
            "title": self.options.get("title", ""),
            "x": np.asarray(values) if not isinstance(values[0], str) else values,
            "series": {label: (np.asarray(c.values), np.asarray(c.intervals)) for label, c in curves.items()},
            "bounds": {label: np.asarray(c.values) for label, c in bounds.items()},
        }
        labels = (self.options["xlabel"], self.options["ylabel"])
        drawn = plot.error_curves([part], *labels, log_x="log-x" in self.options, log_y=True)[0]
        drawn.set_size_inches(7.2, 4.4)
        folder = Path(self.env.srcdir) / "_build" / "drawn"
        folder.mkdir(parents=True, exist_ok=True)
        name = f"{self.env.docname.replace('/', '-')}-{self.env.new_serialno('sweep')}.svg"
        with rc_context({"svg.hashsalt": name}):
            drawn.savefig(folder / name, metadata={"Date": None})
        described = f"{self.options['ylabel']} over {self.options['xlabel']}"
        image = nodes.image(uri=f"/_build/drawn/{name}", alt=described)
        self.env.images.add_file(self.env.docname, f"_build/drawn/{name}")
        return [nodes.figure("", image, nodes.caption("", "", *self.caption()))]


class SweepTable(Sweep):
    """A table of errors over one parameter of a recorded sweep, with bounds."""

    def run(self) -> list[nodes.Node]:
        values, curves, bounds = self.chosen()
        columns = {**bounds, **curves}
        rows = ["| " + " | ".join([self.options["xlabel"], *columns]) + " |", "| --- " * (len(columns) + 1) + "|"]
        for i, value in enumerate(values):
            first = short(value) if not isinstance(value, str) else value
            rows.append("| " + " | ".join([first, *(cell(c.values[i]) for c in columns.values())]) + " |")
        return [
            *self.parse_text_to_nodes("\n".join(rows)),
            nodes.paragraph("", "", *self.caption(), classes=["caption"]),
        ]


class RecordTable(SphinxDirective):
    """A table of a record, and below it what the numbers depend on."""

    required_arguments = 1
    folder = "benchmark"

    def record(self) -> dict[str, Any]:
        """The record, on which the page depends."""
        return read(self, self.folder, self.arguments[0])

    def shown(self, columns: Sequence[str], rows: Iterable[Sequence[Any]], note: str) -> list[nodes.Node]:
        """The table, and the note with the file of the record.

        columns: their names; numbers stand on the right, in columns whose names begin with ">".
        """
        rule = ["---:" if name.startswith(">") else "---" for name in columns]
        lines = ([name.removeprefix(">") for name in columns], rule, *rows)
        table = "\n".join(f"| {' | '.join(map(str, cells))} |" for cells in lines)
        note = f"{note}; record: `docs/{self.folder}/{self.arguments[0]}.json`."
        return [*self.parse_text_to_nodes(table), *self.parse_text_to_nodes(note)]


class BenchmarkTable(RecordTable):
    """Speed, memory and slowest stage of every config of a record of `scripts/benchmark.py`."""

    def run(self) -> list[nodes.Node]:
        record, lines = self.record(), []
        # those of `--random` are in a table of their own
        usual = [row for row in record["rows"] if row["part"] not in ("batch", "draws") or not row["name"]]
        whole = [row for row in usual if row["part"] == "batch" and row["threads"] == 1]
        for batch in whole:
            same = {key: batch[key] for key in ("config", "threads", "device")}
            rows = [row for row in usual if same.items() <= row.items()]
            part = {row["part"]: row for row in rows}
            stages = [row for row in rows if row["part"] == "stage" and row["name"].startswith("recommended.")]
            slowest = max(stages, key=lambda row: row["seconds"])
            cells = [
                *(f"`{batch['config'].removeprefix('sweeps/')}`", batch["trials"]),
                *(cell(batch["trials"] / batch["seconds"]), f"{part['draws']['seconds'] / batch['seconds']:.0%}"),
                *(cell(part["memory"]["peak_bytes"] / 1e9), f"`{slowest['name'].partition('.')[2]}`"),
                cell(slowest["over_floor"]),
            ]
            lines.append(cells)
        machine = record["machine"]
        columns = ("config", ">batch", ">trials/s", ">draws", ">GB", "slowest stage", ">over floor")
        where = machine["cuda"] if whole[0]["device"] == "cuda" else f"{machine['processor']}, one thread"
        return self.shown(columns, lines, f"{where}; torch {machine['torch']}")


class DrawsTable(RecordTable):
    """Time of the draws from every source, and their share of the batch, of a record of
    `scripts/benchmark.py`.
    """

    def run(self) -> list[nodes.Node]:
        record, lines = self.record(), []
        named = [row for row in record["rows"] if row["name"] and row["part"] in ("batch", "draws")]
        for draws in (row for row in named if row["part"] == "draws"):
            same = {key: draws[key] for key in ("config", "device", "name", "threads", "trials")}
            batch = next(row for row in named if row["part"] == "batch" and same.items() <= row.items())
            share = f"{draws['seconds'] / batch['seconds']:.1%}"
            about = f"`{draws['config'].removeprefix('sweeps/')}`", draws["trials"], f"`{draws['name']}`"
            lines.append((*about, draws["device"], draws["threads"], cell(1e3 * draws["seconds"]), share))
        machine = record["machine"]
        columns = ("config", ">batch", "source", "device", ">threads", ">ms", ">of the batch")
        about = f"{machine['processor']} with {machine['vectors']}; torch {machine['torch']}"
        return self.shown(columns, lines, about)


class BusyTable(RecordTable):
    """Speed of every sweep of a record of `scripts/sweep_busy.py`, and how busy the GPU was."""

    def run(self) -> list[nodes.Node]:
        record = self.record()
        rows = [
            (
                *(f"`{row['sweep']}`", row["trials"], cell(row["trials_per_s"])),
                "-" if row["busy"] is None else format(row["busy"], ".1%"),
            )
            for row in record["rows"]
        ]
        machine = record["machine"]
        note = f"{machine['gpu']}; torch {machine['torch']}; processes: {machine['workers']}"
        return self.shown(("sweep", ">trials at once", ">trials/s", ">busy"), rows, note)


class CompiledTable(RecordTable):
    """Gain of every program of a record of `scripts/compiled_speed.py`."""

    def run(self) -> list[nodes.Node]:
        record = self.record()
        rows = [
            (
                *(f"`{row['config']}`", f"`{row['method']}`", cell(1e3 * row["seconds"]), cell(row["gain"])),
                *(f"{row['difference']:.0e}", cell(row["compile_s"])),
            )
            for row in record["rows"]
        ]
        machine = record["machine"]
        note = f"{machine['processor']}, one thread; torch {machine['torch']}, {machine['backend']}"
        return self.shown(("config", "method", ">ms", ">gain", ">difference", ">compile s"), rows, note)


class TradeTable(RecordTable):
    """Time and loss of every alternative of one system, and of every step that has some."""

    folder = "trade"

    def run(self) -> list[nodes.Node]:
        record, lines = self.record(), []
        for choice, alternatives in {record["choice"]: record["alternatives"], **record["others"]}.items():
            losses = list(dict.fromkeys(name for row in alternatives for name in row["loss"]))
            for i, row in enumerate(alternatives):
                time = "-" if row["cpu_s"] is None else cell(1e3 * row["cpu_s"])
                exact = {name: "exact" if x <= EXACT_DB else f"{x:.3g}" for name, x in row["loss"].items()}
                named = [f"{x} (`{name}`)" if len(losses) > 1 else x for name, x in exact.items()]
                loss = ", ".join(named) or "failed"
                only = f" (`{losses[0]}`)" if len(losses) == 1 else ""  # the same of every alternative
                first = f"{choice}{only}" if i == 0 else ""
                lines.append((first, row["name"], time, loss, "yes" if row["recommended"] else ""))
        limits = ", ".join(f"`{name}` {value:g}" for name, value in record["tolerance"].items())
        with_ = f"torch {record['machine']['torch']}, threads: {record['machine']['threads']}"
        columns = ("step", "alternative", ">CPU time (ms)", "loss", "recommended")
        return self.shown(columns, lines, f"Config `{record['config']}`; largest loss accepted: {limits}; {with_}")


class RequiresTable(SphinxDirective):
    """How well predicted losses agree with measured ones, for all systems."""

    def run(self) -> list[nodes.Node]:
        lines = [
            "| system | scenes | predicted losses | acceptable | precision | recall | median error near the tolerance |"
        ]
        lines.append("| --- | ---: | ---: | ---: | ---: | ---: | ---: |")
        for system in SYSTEMS:
            r = read(self, "requires", system)
            numbers = (r["scenes"], int(r["rows"]), int(r["acceptable"]))
            shares = f"{r['precision']:.3f} | {r['recall']:.3f} | {r['median_error']:.2g} dB"
            lines.append(f"| `{system}` | {' | '.join(map(str, numbers))} | {shares} |")
        return self.parse_text_to_nodes("\n".join(lines))


class ReproducedTable(SphinxDirective):
    """Figures and tables of one paper: published, ours, verdict."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        record = read(self, "reproduce", self.arguments[0])
        lines = ["| item | compared | published | ours | draws | verdict |", "| --- | --- | --- | --- | --- | --- |"]
        for found in record["items"]:
            lines += self.rows(found)
        made = {json.dumps({**one["made"], "seconds": None}): one["made"] for one in record["items"] if one["made"]}
        notes = []
        for one in made.values():
            labels = [
                x["item"] for x in record["items"] if x["made"] and {**x["made"], "seconds": one["seconds"]} == one
            ]
            versions = ", ".join(f"{name} {version}" for name, version in one["versions"].items())
            where = f"{one['date']}, commit `{one['commit']}`, {one['machine']}, {versions}"
            notes.append(f"{one['form'].capitalize()} form, {where}: {', '.join(labels)}.")
        source = f"{record['source']}. Record: `docs/reproduce/{self.arguments[0]}.json`."
        return self.parse_text_to_nodes("\n\n".join([source, "\n".join(lines), *notes]))

    def rows(self, found: dict[str, Any]) -> list[str]:
        """A row for the item, and one for each comparison."""
        form = " (reduced form)" if found["made"] and found["made"]["form"] == "reduced" else ""
        why = f": {found['why']}" if found["why"] else ""
        lines = [f"| **{found['item']}** | *{found['subject']}*{why} | | | | **{found['verdict']}**{form} |"]
        for check in found["checks"]:
            published, ours = (x if isinstance(x, str) else short(x) for x in (check["published"], check["ours"]))
            std = "" if not check["std"] else f" ± {check['std']:.2g}"
            draws = check["draws"] or ""
            lines.append(f"| | {check['name']} | {published} | {ours}{std} | {draws} | {check['verdict']} |")
        return [line.replace("\n", " ") for line in lines]


class ReproducedErrors(SphinxDirective):
    """What the papers have wrong, from the records of all papers."""

    def run(self) -> list[nodes.Node]:
        lines = ["| paper | item | what | printed | what shows it |", "| --- | --- | --- | --- | --- |"]
        for path in sorted((Path(self.env.srcdir) / "reproduce").glob("*.json")):
            for found in read(self, "reproduce", path.stem)["items"]:
                wrong = [check for check in found["checks"] if check["verdict"] == "error of the paper"]
                words = [f"{found['item']} | {x['name']} | {x['published']} | {x['ours']}" for x in wrong]
                lines += [f"| `{path.stem}` | {row} |" for row in words]
        return self.parse_text_to_nodes("\n".join(lines))


class ReproducedCounts(SphinxDirective):
    """How many figures and tables of every paper have which verdict; a reduced form has none."""

    def run(self) -> list[nodes.Node]:
        words = ("reproduced", "better", "not reproduced", "reduced form only", "error of the paper", *SHOWN)
        lines = [f"| paper | {' | '.join(words)} |", f"| --- {'| ---: ' * len(words)}|"]
        for path in sorted((Path(self.env.srcdir) / "reproduce").glob("*.json")):
            items = read(self, "reproduce", path.stem)["items"]
            reduced = [bool(one["made"]) and one["made"]["form"] == "reduced" for one in items]
            verdicts = [words[3] if few else one["verdict"] for one, few in zip(items, reduced, strict=True)]
            lines.append(f"| `{path.stem}` | {' | '.join(str(verdicts.count(word)) for word in words)} |")
        return self.parse_text_to_nodes("\n".join(lines))


class BenchTable(SphinxDirective):
    """Scores of all recorded methods of a benchmark."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        record = recorded(self.arguments[0])
        self.env.note_dependency(str(HERE / "recorded" / f"{self.arguments[0]}.json"))
        head, *rows = show.cells(record)
        lines = [head, ["---", *["---:"] * (len(head) - 1)], *([f"`{name}`", *numbers] for name, *numbers in rows)]
        table = "\n".join(f"| {' | '.join(line)} |" for line in lines)
        return [*self.parse_text_to_nodes(table), *self.parse_text_to_nodes(f"{show.about(record)}.")]


class BenchTracks(SphinxDirective):
    """Shares of right, and of sure and wrong trials of some methods in each track."""

    required_arguments = 1
    option_spec = {"methods": directives.unchanged_required}

    def run(self) -> list[nodes.Node]:
        record = recorded(self.arguments[0])
        self.env.note_dependency(str(HERE / "recorded" / f"{self.arguments[0]}.json"))
        names = [name.strip() for name in self.options["methods"].split(",")]
        shown = {"right": "{:.0%}", "sure_wrong": "({:.0%})"}
        lines = [f"| scenes | {' | '.join(f'`{name}`' for name in names)} |", f"| --- {'| ---: ' * len(names)}|"]
        found = [record["methods"][name]["tracks"] for name in names]
        for track in dict.fromkeys(track for tracks in found for track in tracks):
            rows = [{key: row[0] for key, row in tracks.get(track, {}).items() if key in shown} for tracks in found]
            texts = [
                " ".join(form.format(row[key]) for key, form in shown.items() if key in row) or "-" for row in rows
            ]
            lines.append(f"| {track} | {' | '.join(texts)} |")
        return self.parse_text_to_nodes("\n".join(lines))


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the directives."""
    for name, directive in {
        "sweep-figure": SweepFigure,
        "sweep-table": SweepTable,
        "benchmark-table": BenchmarkTable,
        "draws-table": DrawsTable,
        "busy-table": BusyTable,
        "compiled-table": CompiledTable,
        "trade-table": TradeTable,
        "requires-table": RequiresTable,
        "reproduced-table": ReproducedTable,
        "reproduced-counts": ReproducedCounts,
        "reproduced-errors": ReproducedErrors,
        "bench-table": BenchTable,
        "bench-tracks": BenchTracks,
    }.items():
        app.add_directive(name, directive)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
