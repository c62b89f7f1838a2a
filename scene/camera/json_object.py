"""The JSON object of a camera's file. Rule: what is no JSON is refused; any other value is an object without keys."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from trilane.errors import BadInputError
from trilane.files import read_text, whole_number


def read_object(path: Path, expected: str) -> dict[str, Any]:
    """The object in `path`, `expected` in words; empty for another value. Raises BadInputError for what is no JSON."""
    try:
        content = json.loads(read_text(path, expected), parse_int=whole_number)
    except (ValueError, RecursionError) as error:
        raise BadInputError(path, f"no valid JSON ({error})", expected) from None
    return content if isinstance(content, dict) else {}
