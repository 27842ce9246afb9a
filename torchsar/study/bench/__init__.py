"""Benchmarks of methods: frozen scenes with their truth, and scores that cannot be gamed.

    from torchsar.study import bench
    record = bench.score("autofocus", {"mine": my_function}, small=True)
    print(bench.table(bench.together([record])))

A method takes data (trial, pulse, range) and returns phases (trial, pulse), alone or as a tuple
(phase, std, ok); see `score`. The command `torchsar bench` does the same.
"""

from torchsar.study.bench import show as show
from torchsar.study.bench.frame import Batch, Bench, Entry, Quantity, World
from torchsar.study.bench.records import VERSION, bench, checksum, read, recorded, score, together
from torchsar.study.bench.scenes import Scenes
from torchsar.study.bench.show import about, figure, latex, save, table

__all__ = [
    "VERSION",
    "Batch",
    "Bench",
    "Entry",
    "Quantity",
    "Scenes",
    "World",
    "about",
    "bench",
    "checksum",
    "figure",
    "latex",
    "read",
    "recorded",
    "save",
    "score",
    "table",
    "together",
]
