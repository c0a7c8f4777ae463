"""Shipped pages, drive cycles, driver tables and policies."""

import json
from pathlib import Path
from typing import Any

ASSETS = Path(__file__).parent


def page_of(name: str, data: Any) -> str:
    """Return a page of this folder with data, which its script reads."""
    # No tag may begin within a script.
    text = json.dumps(data, ensure_ascii=False, separators=(",", ":")).replace("<", "\\u003c")
    return (ASSETS / name).read_text(encoding="utf-8").replace("DATA", text, 1)
