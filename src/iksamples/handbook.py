"""The reference pages that are generated from the code, so that they cannot fall behind it."""

import json
from collections.abc import Iterable, Iterator
from typing import Any, get_args, get_origin

from pydantic.fields import FieldInfo

from iksamples.columns import CERTIFICATES, RUNS, TABLE
from iksamples.study import Section, Study


HEAD = """\
# The study file

A study is one YAML file. Every setting has a default, and the defaults are the paper's study, so a
file needs a `name` and whatever differs:

```yaml
name: wider
network:
  hidden: [32]
```

```
snakemake --cores 2 --configfile wider.yaml
```

It lands in `results/wider` and `reports/wider`; two studies never touch each other's files. A
mistake in the file is answered with the key and what is allowed there before any job starts, and
`iksamples check wider.yaml` says the same without running anything (and in which line a file is no
YAML, which Snakemake, reading it first, does not). Only `true` and `false` are booleans and only
decimal numbers are numbers: `no`, `010` and `1:30` are text.

Of several files each is laid over those before it, and so is what `--config` says, section by
section (Snakemake takes no dotted keys):

```
snakemake --cores 2 --configfile wider.yaml --config training='{seeds: 40}'
```

A folder of your own uses the workflow as a module, with a `config/` beside its Snakefile; paths are
relative to that folder:

```python
configfile: "config/config.yaml"

module iksamples:
    snakefile: "/path/to/iksamples/workflow/Snakefile"
    config: config

use rule * from iksamples
```

Beside every file of results lies its SHA-256 (`.table.csv.sha256`). A result that was changed or
damaged is not read; it is put out of the way as `table.csv.damaged`, and the same command makes it
again.

This page and `schema.json` (for editors that complete YAML) are generated: `iksamples handbook`.
"""


def settings_page() -> str:
    """``config/README.md``: every setting, and every column of the tables."""
    lines = [HEAD, "## Settings", ""]
    lines += ["| key | default | allowed | meaning |", "|---|---|---|---|"]
    for key, field in _walk(Study):
        lines.append(
            f"| `{key}` | {_default(field)} | {_allowed(field)} | {field.description or ''} |"
        )
    tables = {"runs.parquet": RUNS, "table.csv": TABLE, "certificates.csv": CERTIFICATES}
    for file, columns in tables.items():
        lines += ["", f"## Columns of `results/<study>/{file}`", ""]
        lines += ["| column | unit | meaning |", "|---|---|---|"]
        lines += [
            f"| `{name}` | {column.unit} | {column.meaning} |" for name, column in columns.items()
        ]
    return "\n".join(lines) + "\n"


def schema() -> str:
    """``config/schema.json``: the JSON schema of the study file."""
    return json.dumps(Study.model_json_schema(), indent=2) + "\n"


def _walk(section: type[Section], prefix: str = "") -> Iterator[tuple[str, FieldInfo]]:
    """Every setting with its full key; the entries of a mapping of sections as ``<name>``."""
    for name, field in section.model_fields.items():
        inner = list(_sections(field.annotation))
        mapping = get_origin(field.annotation) is dict
        if not inner or mapping or type(None) in get_args(field.annotation):
            yield prefix + name, field
        for model in inner:
            if not mapping:
                yield from _walk(model, f"{prefix}{name}.")
                continue
            # What a method may change of `network` and `training` is listed there.
            shape = f" ({_shape(model)})" if "shape" in model.model_fields else ""
            for key, part in model.model_fields.items():
                yield f"{prefix}{name}.<name>.{key}{shape}", part


def _sections(annotation: Any) -> Iterator[type[Section]]:
    """The sections that an annotation holds, however deep."""
    if isinstance(annotation, type) and issubclass(annotation, Section):
        yield annotation
    for part in get_args(annotation):
        yield from _sections(part)


def _shape(model: type[Section]) -> str:
    return str(get_args(model.model_fields["shape"].annotation)[0])


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return "required"
    value = field.default
    if isinstance(value, Section):
        return "as the study's"
    if isinstance(value, dict):
        return "`{}`" if not value else ", ".join(f"`{key}`" for key in value)
    return f"`{json.dumps(value)}`"


def _allowed(field: FieldInfo) -> str:
    """Values a field may have, read from its type and limits."""
    return _type(field.annotation) + _limits(field.metadata)


def _limits(metadata: Iterable[Any]) -> str:
    signs = {"gt": ">", "ge": "≥", "lt": "<", "le": "≤"}
    found = [
        f"{sign} {getattr(part, name)}"
        for entry in metadata
        for part in getattr(entry, "metadata", [entry])
        for name, sign in signs.items()
        if getattr(part, name, None) is not None
    ]
    return " " + ", ".join(found) if found else ""


def _type(annotation: Any) -> str:
    origin, parts = get_origin(annotation), get_args(annotation)
    if hasattr(annotation, "__metadata__"):
        return _type(annotation.__origin__) + _limits(annotation.__metadata__)
    if origin is None:
        if isinstance(annotation, type) and issubclass(annotation, Section):
            return "section"
        names = {int: "integer", float: "number", str: "text", bool: "true, false"}
        return names.get(annotation, "null" if annotation is type(None) else str(annotation))
    if origin is list:
        return f"list of {_type(parts[0])}"
    if origin is tuple:
        return f"{len(parts)} numbers"
    if origin is dict:
        return f"mapping of name to {_type(parts[1])}"
    if all(isinstance(part, str) for part in parts):
        return ", ".join(f"`{part}`" for part in parts)
    return " or ".join(dict.fromkeys(_type(part) for part in parts))
