"""Files of the numbers of a result."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor


def write_json(path: Path, tree: Mapping[str, Any]) -> None:
    """Write a JSON file. Numbers that are not finite become null, as the format requires."""
    path.write_text(json.dumps(_finite(tree), indent=1, allow_nan=False) + "\n", encoding="utf-8")


def _finite(x: Any) -> Any:
    if isinstance(x, Mapping):
        return {str(k): _finite(v) for k, v in x.items()}
    if isinstance(x, (list, tuple)):
        return [_finite(v) for v in x]
    if isinstance(x, Tensor):
        return _finite(x.tolist())
    return None if isinstance(x, float) and not math.isfinite(x) else x
