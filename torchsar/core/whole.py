"""Calls that torch.compile takes over as one piece."""

from __future__ import annotations

from typing import Any

import torch._dynamo
from torch import nn


@torch._dynamo.nonstrict_trace
def called(stage: nn.Module, args: Any, values: Any) -> Any:
    return stage(*args, **values)
