"""Options from dataclasses, with help texts whose paragraphs flow.

tyro would keep the line breaks of a field's docstring, because its indentation looks like deliberate layout to it. This rule
hands it the paragraphs as single lines.
"""

import ast
import dataclasses
import inspect
import textwrap
from functools import cache
from itertools import pairwise
from typing import Annotated, Any, get_type_hints

import tyro
from tyro.constructors import ConstructorRegistry, StructConstructorSpec, StructFieldSpec, StructTypeInfo

_ALIASES = {("SearchSpace", "max_filters"): "--max-filters"}
"""Second names of options, by class and field."""

REGISTRY = ConstructorRegistry()
"""Rules for tyro.cli."""


@REGISTRY.struct_rule
def _dataclass_rule(info: StructTypeInfo) -> StructConstructorSpec | None:
    """Return how a dataclass is made from options; None for other types."""
    if not dataclasses.is_dataclass(info.type):
        return None
    hints, texts = get_type_hints(info.type, include_extras=True), _field_help(info.type)
    specs = []
    for f in dataclasses.fields(info.type):
        hint: Any = hints[f.name]
        if alias := _ALIASES.get((info.type.__name__, f.name)):
            hint = Annotated[hint, tyro.conf.arg(aliases=[alias])]
        specs.append(StructFieldSpec(f.name, hint, _default(f, info), helptext=texts.get(f.name)))
    return StructConstructorSpec(instantiate=info.type, fields=tuple(specs))


def _default(f: dataclasses.Field, info: StructTypeInfo) -> Any:
    """Return the default of a field: of the default instance if there is one, or of the class."""
    if isinstance(info.default, info.type):
        return getattr(info.default, f.name)
    if f.default is not dataclasses.MISSING:
        return f.default
    return tyro.MISSING if f.default_factory is dataclasses.MISSING else f.default_factory()


@cache
def _field_help(configuration: type) -> dict[str, str]:
    """Return the docstrings below the fields of a dataclass and its bases, each paragraph as one line."""
    texts: dict[str, str] = {}
    for owner in reversed(configuration.__mro__):
        if not dataclasses.is_dataclass(owner):
            continue
        body = [line for c in ast.parse(textwrap.dedent(inspect.getsource(owner))).body for line in getattr(c, "body", [])]
        for statement, after in pairwise(body):
            if not (isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name)):
                continue
            if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant) and isinstance(after.value.value, str):
                paragraphs = inspect.cleandoc(after.value.value).split("\n\n")
                texts[statement.target.id] = "\n\n".join(" ".join(paragraph.split()) for paragraph in paragraphs)
    return texts
