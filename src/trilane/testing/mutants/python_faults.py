"""Faults of Python files. Rule: what cosmic-ray's operators do, and what a tired person does: a line forgotten, two
arguments or table rows exchanged, a keyword left out, a wrong key, `min` for `max`.

Annotations, docstrings, imports and messages stay as they are: nothing that runs depends on them.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache, partial
from itertools import pairwise
from re import fullmatch
from typing import Any

from trilane.testing.mutants.fault import Edit

Place = tuple[int, int]
Span = tuple[Place, Place]

#: Names that are easily taken for each other.
LIKE = {
    "all": "any",
    "any": "all",
    "argmax": "argmin",
    "argmin": "argmax",
    "ceil": "floor",
    "cos": "sin",
    "floor": "ceil",
    "max": "min",
    "maximum": "minimum",
    "min": "max",
    "minimum": "maximum",
    "rint": "floor",
    "round": "int",
    "sin": "cos",
    "width": "height",
    "height": "width",
}
#: Functions that give the same for their arguments in any order.
ANY_ORDER = {"max", "min", "maximum", "minimum", "hypot", "gcd", "suppress"}
WORD = r"[A-Za-z_][\w.:/-]*"
#: cosmic-ray operators that need arguments, or that change what nobody tests.
LEFT_OUT = {"VariableReplacer", "VariableInserter", "RemoveDecorator"}


def python_faults(text: str) -> list[Edit]:
    """Every fault that can be put into the source `text`. Raises SyntaxError."""
    tree = ast.parse(text)
    quiet = list(_quiet_spans(tree))
    found = [*_by_cosmic_ray(text), *_by_hand(text, tree)]
    return [edit for span, edit in found if not any(_inside(span, each) for each in quiet)]


def _inside(span: Span, outer: Span) -> bool:
    return outer[0] <= span[0] and span[1] <= outer[1]


def _span(node: Any) -> Span:
    return (node.lineno, node.col_offset), (node.end_lineno, node.end_col_offset)


def _quiet_spans(tree: ast.Module) -> Iterator[Span]:
    """Where a change changes nothing that runs."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom) or _is_docstring(node) or _is_for_types(node):
            yield _span(node)
        elif isinstance(node, ast.AnnAssign | ast.arg) and node.annotation:
            yield _span(node.annotation)
        elif isinstance(node, ast.FunctionDef) and node.returns:
            yield _span(node.returns)


def _is_docstring(node: ast.AST) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)


def _is_for_types(node: ast.AST) -> bool:
    if isinstance(node, ast.If):
        return ast.unparse(node.test) == "TYPE_CHECKING"
    return isinstance(node, ast.Call) and getattr(node.func, "id", "") in {"TypeVar", "cast"}


@cache
def _operators() -> list[tuple[str, Any]]:
    """Name and object of every operator of cosmic-ray that takes no arguments."""
    from cosmic_ray.plugins import get_operator, operator_names

    names = [name for name in operator_names() if name.rpartition("/")[2] not in LEFT_OUT]
    return [(name.rpartition("/")[2].split("_")[0], get_operator(name)()) for name in names]


def _by_cosmic_ray(text: str) -> Iterator[tuple[Span, Edit]]:
    from cosmic_ray.ast import ast_nodes, get_ast
    from cosmic_ray.mutating import mutate_code

    nodes = list(ast_nodes(get_ast(text)))
    for name, operator in _operators():
        places = [place for node in nodes for place in operator.mutation_positions(node)]
        for occurrence, (begin, end) in enumerate(places):
            yield (begin, end), Edit(begin[0], name, partial(_mutated, mutate_code, text, operator, occurrence))


def _mutated(mutate_code: Any, text: str, operator: Any, occurrence: int) -> str:
    return mutate_code(text, operator, occurrence) or text


def _by_hand(text: str, tree: ast.Module) -> Iterator[tuple[Span, Edit]]:
    source = _Source(text)
    unordered = {id(part) for node in ast.walk(tree) for part in _unordered(node)}
    for node in ast.walk(tree):
        for kind, span, new in _rewrites(node, source):
            if new != source.at(span) and not (kind.endswith("Exchanged") and id(node) in unordered):
                yield span, Edit(span[0][0], kind, partial(source.with_, span, new))


def _rewrites(node: ast.AST, source: _Source) -> Iterator[tuple[str, Span, str]]:
    """(kind, what is replaced, by what) for the faults that begin at this node."""
    if _can_be_forgotten(node):
        yield "StatementForgotten", _span(node), "pass"
    elif isinstance(node, ast.Call):
        yield from (("ArgumentsExchanged", *pair) for pair in _exchanged(node.args, source))
        for keyword in node.keywords:
            if keyword.arg:
                yield "KeywordLeftOut", _with_comma(keyword, source), ""
    elif isinstance(node, ast.Tuple | ast.List) and isinstance(node.ctx, ast.Load):
        yield from (("RowsExchanged", *pair) for pair in _exchanged(node.elts, source))
    elif isinstance(node, ast.Dict):
        yield from (("RowsExchanged", *pair) for pair in _exchanged(node.values, source))
    elif isinstance(node, ast.Constant) and isinstance(node.value, str) and fullmatch(WORD, node.value):
        yield "WordChanged", _span(node), repr(f"{node.value}_")
    elif isinstance(node, ast.Name | ast.Attribute):
        name = node.id if isinstance(node, ast.Name) else node.attr
        if name in LIKE:
            (_, _), end = _span(node)
            yield "NameLikeIt", ((end[0], end[1] - len(name)), end), LIKE[name]


def _unordered(node: ast.AST) -> Iterator[ast.AST]:
    """The parts of `node` in which order changes nothing: arguments of `ANY_ORDER`, kinds of exceptions, and rows that
    something is looked for `in`."""
    if isinstance(node, ast.Call) and ast.unparse(node.func).rpartition(".")[2] in ANY_ORDER:
        yield node
    elif isinstance(node, ast.ExceptHandler) and node.type:
        yield node.type
    elif isinstance(node, ast.Compare) and isinstance(node.ops[0], ast.In | ast.NotIn):
        yield node.comparators[0]


def _can_be_forgotten(node: ast.AST) -> bool:
    """Whether the node is a statement without which the rest still runs."""
    if isinstance(node, ast.Expr):
        return isinstance(node.value, ast.Call)
    if isinstance(node, ast.Assign):
        return all(isinstance(target, ast.Attribute | ast.Subscript) for target in node.targets)
    return isinstance(node, ast.AugAssign | ast.Raise)


def _exchanged(nodes: list[ast.expr], source: _Source) -> Iterator[tuple[Span, str]]:
    for first, second in pairwise(nodes):
        if isinstance(first, ast.Starred) or isinstance(second, ast.Starred):
            continue
        (begin, first_end), (second_begin, end) = _span(first), _span(second)
        between = source.at((first_end, second_begin))
        yield (begin, end), source.at(_span(second)) + between + source.at(_span(first))


def _with_comma(node: ast.AST, source: _Source) -> Span:
    begin, end = _span(node)
    after = source.after(end)
    return begin, (end[0], end[1] + (after.index(",") + 1 if after.lstrip().startswith(",") else 0))


class _Source:
    """A text by lines from 1 and columns in UTF-8 bytes, as `ast` counts them."""

    def __init__(self, text: str) -> None:
        self.lines = [line.encode() for line in text.splitlines(keepends=True)]

    def at(self, span: Span) -> str:
        (top, left), (bottom, right) = span
        if top == bottom:
            return self.lines[top - 1][left:right].decode()
        middle = self.lines[top : bottom - 1]
        return b"".join([self.lines[top - 1][left:], *middle, self.lines[bottom - 1][:right]]).decode()

    def after(self, place: Place) -> str:
        """The rest of the line."""
        return self.lines[place[0] - 1][place[1] :].decode()

    def with_(self, span: Span, new: str) -> str:
        (top, left), (bottom, right) = span
        head = [*self.lines[: top - 1], self.lines[top - 1][:left]]
        return b"".join([*head, new.encode(), self.lines[bottom - 1][right:], *self.lines[bottom:]]).decode()
