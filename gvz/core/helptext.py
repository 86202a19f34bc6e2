"""Help texts of command lines."""

import contextlib
from collections.abc import Generator

import docstring_parser


@contextlib.contextmanager
def paragraphs() -> Generator[None]:
    """Within the block, tyro shows the docstring of a field as paragraphs.

    Without it, a line of the help ends where one of the source does if the next one is indented, as in all fields here.
    """
    parse = docstring_parser.parse_from_object

    def parse_joined(obj: type) -> docstring_parser.Docstring:
        parsed = parse(obj)
        for field in parsed.params:
            if field.description is not None:
                texts = field.description.split("\n\n")
                field.description = "\n\n".join(" ".join(text.split()) for text in texts)
        return parsed

    docstring_parser.parse_from_object = parse_joined
    try:
        yield
    finally:
        docstring_parser.parse_from_object = parse
