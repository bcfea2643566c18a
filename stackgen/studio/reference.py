"""The page that describes the endpoints: made from the OpenAPI schema, so that it asks for nothing from outside."""

from __future__ import annotations

import json
from html import escape
from typing import Any


def reference_page(schema: dict[str, Any]) -> str:
    """Make the page."""
    parts = [_endpoint(path, method, told) for path, by in schema["paths"].items() for method, told in by.items()]
    models = [_model(name, model) for name, model in schema.get("components", {}).get("schemas", {}).items()]
    return _PAGE.format(
        title=escape(schema["info"]["title"]),
        told=escape(schema["info"].get("description", "")),
        endpoints="\n".join(parts),
        models="\n".join(models),
    )


def _endpoint(path: str, method: str, told: dict[str, Any]) -> str:
    content = told.get("requestBody", {}).get("content", {}).get("application/json", {}).get("schema", {})
    takes = f"<p>Takes: <code>{escape(_name(content))}</code></p>" if content else ""
    heading = f"<h3><code>{method.upper()} {escape(path)}</code></h3>"
    return f"<section>{heading}<p>{escape(told['summary'])}</p>{takes}</section>"


def _model(name: str, model: dict[str, Any]) -> str:
    fields = escape(json.dumps(model.get("properties", {}), indent=1))
    told = escape(model.get("description", ""))
    details = f"<details><summary>Fields</summary><pre>{fields}</pre></details>"
    return f"<section><h3>{escape(name)}</h3><pre>{told}</pre>{details}</section>"


def _name(schema: dict[str, Any]) -> str:
    return str(schema.get("$ref", "")).rpartition("/")[2]


_PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}: API</title><link rel="icon" href="data:,"><link rel="stylesheet" href="studio.css"></head>
<body class="reference"><h1>{title}: API</h1><p>{told} The same as <a href="openapi.json">openapi.json</a>.
<a href=".">Back to the studio</a></p><h2>Endpoints</h2>{endpoints}<h2>What they take</h2>{models}</body></html>
"""
