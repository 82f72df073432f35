"""Help whose paragraphs flow: tyro takes a field's docstring with its indentation, and breaks lines where that does."""

import contextlib
import inspect


@contextlib.contextmanager
def flowing():
    """For a `with` block in which tyro reads docstrings: the lines of a paragraph are one."""
    import docstring_parser

    parse = docstring_parser.parse_from_object

    def parsed(described):
        out = parse(described)
        for field in out.params:
            paragraphs = inspect.cleandoc(field.description or "").split("\n\n")
            field.description = "\n\n".join(" ".join(paragraph.split()) for paragraph in paragraphs) or None
        return out

    docstring_parser.parse_from_object = parsed
    try:
        yield
    finally:
        docstring_parser.parse_from_object = parse
