"""A check of the finished site: no page loads anything from a network."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx
from sphinx.util import logging

LOG = logging.getLogger(__name__)
# attributes that load something, and addresses in style sheets; plain links (<a href>) load nothing
LOADS = (
    re.compile(r"<(?:script|img|iframe|source|video|audio|embed)\b[^>]*?\bsrc\s*=\s*[\"']?(?:https?:)?//[^\"'\s>]+"),
    re.compile(
        r"<link\b(?=[^>]*\brel=[\"']?(?:stylesheet|preload|preconnect|icon))[^>]*?\bhref\s*=\s*[\"']?(?:https?:)?//[^\"'\s>]+"
    ),
    re.compile(r"(?:url\(|@import\s+)[\"']?\s*(?:https?:)?//[^)\"']+"),
)


def loads(text: str) -> Iterator[str]:
    """Parts of a page or of a style sheet that load something from a network."""
    for pattern in LOADS:
        yield from (found[0] for found in pattern.finditer(text))


def check(app: Sphinx, error: Exception | None) -> None:
    """Warn of everything that is loaded from a network; warnings are errors in `make docs`."""
    if error is None and app.builder.format == "html":
        for path in sorted(Path(app.outdir).rglob("*")):
            if path.suffix in (".html", ".css"):
                for found in loads(path.read_text(encoding="utf-8")):
                    LOG.warning("%s loads from a network: %s", path.relative_to(app.outdir), found[:200])


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the check."""
    app.connect("build-finished", check)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
