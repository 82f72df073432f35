"""Options from dataclasses, with help texts whose paragraphs flow.

tyro would keep the line breaks of a field's docstring, because it takes the indentation for deliberate layout. This rule
passes it each paragraph as a single line.
"""

import ast
import dataclasses
import inspect
import textwrap
from collections.abc import Collection, Iterable
from functools import cache
from itertools import pairwise
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import tyro
from tyro.constructors import ConstructorRegistry, StructConstructorSpec, StructFieldSpec, StructTypeInfo

_ALIASES = {("SearchSpace", "max_filters"): "--max-filters"}
"""Second names of options, by class and field."""


_TAGS = {"[P]": "(paper)", "[M]": "(measured)", "[R]": "(published)", "[?]": "(estimate)"}
"""Tags of sources in docstrings (docs/style.md), and what help texts say instead."""


def registry(shown: Collection[tuple[type, str]] | None = None) -> ConstructorRegistry:
    """Return the rules for tyro.cli.

    Args:
        shown: Class and field of each option that the help text lists; None for all.
    """
    rules = ConstructorRegistry()

    @rules.struct_rule
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
            if (
                shown is not None
                and (info.type, f.name) not in shown
                and not dataclasses.is_dataclass(getattr(hint, "__origin__", hint))
            ):
                hint = tyro.conf.Suppress[hint]
            default = _default(f, info)
            if default is None or default in ("", ()):
                # The docstring says what happens without the option; "default: None" would not.
                metavar = None if default == () else _metavar(hint)
                hint = Annotated[hint, tyro.conf.arg(help_behavior_hint="", metavar=metavar)]
            specs.append(StructFieldSpec(f.name, hint, default, helptext=texts.get(f.name)))
        return StructConstructorSpec(instantiate=info.type, fields=tuple(specs))

    return rules


def fields_named(options: type, names: Iterable[str]) -> set[tuple[type, str]]:
    """Return class and field of options by their dotted names, e.g. `route.kind`. Raises KeyError for an unknown name."""
    found: set[tuple[type, str]] = set()
    for name in names:
        *groups, last = name.split(".")
        owner: Any = options
        for group in groups:
            owner = get_type_hints(owner)[group]
        if last not in {f.name for f in dataclasses.fields(owner)}:
            raise KeyError(name)
        found.add((owner, last))
    return found


def _default(f: dataclasses.Field, info: StructTypeInfo) -> Any:
    """Return the default of a field: of the default instance if there is one, or of the class."""
    if isinstance(info.default, info.type):
        return getattr(info.default, f.name)
    if f.default is not dataclasses.MISSING:
        return f.default
    return tyro.MISSING if f.default_factory is dataclasses.MISSING else f.default_factory()


def _metavar(hint: Any) -> str:
    """Return the placeholder of an option's value, such as `FLOAT FLOAT`, without the choice of None."""
    if get_origin(hint) in (Annotated, UnionType, Union):
        first, *others = [h for h in get_args(hint) if isinstance(h, type) or get_origin(h)]
        return _metavar(first) + "".join(f"|{_metavar(h)}" for h in others if h is not NoneType)
    if get_origin(hint) is tuple:
        return " ".join(map(_metavar, get_args(hint)))
    return "{" + ",".join(get_args(hint)) + "}" if get_origin(hint) is Literal else hint.__name__.upper()


@cache
def _field_help(configuration: type) -> dict[str, str]:
    """Return the docstrings below the fields of a dataclass and its bases, a line each paragraph."""
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
                text = "\n\n".join(" ".join(paragraph.split()) for paragraph in paragraphs)
                for tag, words in _TAGS.items():
                    text = text.replace(tag, words)
                texts[statement.target.id] = text
    return texts
