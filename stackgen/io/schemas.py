"""JSON Schemas of the files that stackgen writes: what is read back is what they say, or one line."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

from stackgen.errors import StackgenError
from stackgen.io.text import read_json


@cache
def _validator(schema: Path, part: str) -> Any:
    import jsonschema

    content = read_json(schema)
    meant = {"$defs": content["$defs"], "$ref": f"#/$defs/{part}"} if part else content
    return jsonschema.Draft202012Validator(meant)


def require_valid(data: Any, schema: Path, part: str = "") -> None:
    """See that plain data is what a schema says.

    Args:
        data: Data, as JSON gives it.
        schema: File of the schema.
        part: Definition in it that is meant; by default the whole.

    Raises:
        StackgenError: The line begins with the JSON path of the worst fault.
    """
    import jsonschema

    error = jsonschema.exceptions.best_match(_validator(schema, part).iter_errors(data))
    if error is not None:
        raise StackgenError(f"{error.json_path}: {_short_message(error)}")


def _short_message(error: Any) -> str:
    """Say what a schema error says, without quoting half of the file."""
    message = " ".join(error.message.split())
    quoted = repr(error.instance)
    if len(quoted) > 60:
        message = message.replace(quoted, quoted[:50] + "...", 1)
    limits = {"minItems": "at least", "maxItems": "at most"}
    if error.validator == "pattern" and "description" in error.schema:
        return f"{quoted[:60]} is not {error.schema['description']}"
    if error.validator in limits:
        return f"has {len(error.instance)} items; {limits[error.validator]} {error.validator_value} are possible"
    return message if len(message) <= 220 else message[:220] + "..."
