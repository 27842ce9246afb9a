"""The cases of a sweep, built once in a process."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Generic, Protocol, TypeVar

from torchsar.core import Chain
from torchsar.study.config import Loaded


class _Built(Protocol):
    @property
    def chains(self) -> Mapping[str, Chain]: ...


Bench = TypeVar("Bench", bound=_Built)


class Benches(Generic[Bench]):
    """Base of the trials of a system: `build` makes all that one case needs, which stays in the
    process and does not travel to workers.
    """

    def __init__(self, loaded: Loaded, device: str = "cpu") -> None:
        self.loaded, self.device = loaded, device
        self._built: dict[str, Bench] = {}

    def __getstate__(self) -> dict[str, Any]:
        return {"loaded": self.loaded, "device": self.device, "_built": {}}

    def build(self, loaded: Loaded) -> Bench:
        """All that the case of this config needs."""
        raise NotImplementedError

    def bench(self, fixed: Mapping[str, Any]) -> Bench:
        """The built case of these fixed parameters."""
        key = repr(fixed)
        if key not in self._built:
            self._built[key] = self.build(self.loaded.changed(fixed))
        return self._built[key]

    def stages(self, fixed: Mapping[str, Any]) -> set[str]:
        """Names of all stages of this case, whose chains are built."""
        return {stage for chain in self.bench(fixed).chains.values() for stage in chain.stages}
