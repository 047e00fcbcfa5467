"""Small bugs by rule: where a source text can be changed by an operator, a number or an exit.

Comparisons, signs, `and` and `or`, negations, numbers, True and False, and exits from a branch.
Left alone are docstrings, annotations, patterns, texts (so that a message may be worded anew) and
what only places things on a page.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

COMPARISONS: dict[type[ast.cmpop], tuple[str, str]] = {
    ast.Lt: ("<", "<="),
    ast.LtE: ("<=", "<"),
    ast.Gt: (">", ">="),
    ast.GtE: (">=", ">"),
    ast.Eq: ("==", "!="),
    ast.NotEq: ("!=", "=="),
    ast.Is: ("is", "is not"),
    ast.IsNot: ("is not", "is"),
    ast.In: ("in", "not in"),
    ast.NotIn: ("not in", "in"),
}
OPERATORS: dict[type[ast.AST], tuple[str, str]] = {
    ast.Add: ("+", "-"),
    ast.Sub: ("-", "+"),
    ast.Mult: ("*", "/"),
    ast.Div: ("/", "*"),
    ast.FloorDiv: ("//", "/"),
    ast.Pow: ("**", "*"),
    ast.BitAnd: ("&", "|"),
    ast.BitOr: ("|", "&"),
    ast.And: ("and", "or"),
    ast.Or: ("or", "and"),
}
SEQUENCES = (ast.JoinedStr, ast.List, ast.Tuple, ast.ListComp)
EXITS = (ast.Return, ast.Continue, ast.Raise)

# Keywords whose numbers only place or draw something, or say where a warning is shown.
LAYOUT = {"alpha", "dpi", "figsize", "fontsize", "linewidth", "markersize", "stacklevel", "zorder"}


@dataclass(frozen=True)
class Change:
    """A piece of a source text and what replaces it.

    Attributes
    ----------
    start, end : int
        Of the piece, in bytes of UTF-8.
    after : str
        What replaces it.
    line : int
        Of the piece, from 1.
    reach : (int, int) or None
        First and last line that are executed where the piece is, None where that is on import.
    """

    start: int
    end: int
    after: str
    line: int
    reach: tuple[int, int] | None


def changes(text: str, *, numbers: bool = True) -> list[Change]:
    """All changes of a source text by rule, in its order; those of numbers if asked for."""
    found = _Finder(text, numbers).changes()
    return sorted(set(found), key=lambda one: (one.start, one.end, one.after))


class _Finder:
    """What is passed down while the tree is walked: the text and where its lines begin."""

    def __init__(self, text: str, numbers: bool) -> None:
        self.data = text.encode()
        self.numbers = numbers
        self.begins = [0]
        for line in self.data.splitlines(keepends=True):
            self.begins.append(self.begins[-1] + len(line))

    def changes(self) -> Iterator[Change]:
        return self.of_statements(ast.parse(self.data).body, None, inside=False)

    def of_statements(
        self, statements: Sequence[ast.stmt], reach: tuple[int, int] | None, *, inside: bool
    ) -> Iterator[Change]:
        for statement in statements:
            yield from self.of(statement, reach, inside)

    def of(
        self, node: ast.AST, reach: tuple[int, int] | None, inside: bool = True
    ) -> Iterator[Change]:
        """Changes in a node; `reach` is that of the statement it belongs to."""
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            yield from self.of_function(node)
            return
        if isinstance(node, (ast.JoinedStr, ast.pattern)):
            return
        if isinstance(node, ast.If) and not node.orelse and isinstance(node.body[-1], EXITS):
            dropped = node.body[-1]
            yield self.replaced(dropped, "pass", _lines(dropped) if inside else None)
        if isinstance(node, ast.Raise) or (isinstance(node, ast.Expr) and _is_text(node.value)):
            return
        if isinstance(node, ast.expr):
            yield from self.of_expression(node, reach)
        elif isinstance(node, ast.stmt) and inside:
            reach = _lines(node)
        for name, value in ast.iter_fields(node):
            if name in {"annotation", "returns", "type_params"}:
                continue
            for child in value if isinstance(value, list) else [value]:
                if isinstance(child, ast.keyword) and child.arg in LAYOUT:
                    continue
                if isinstance(child, ast.AST):
                    head = child.context_expr if isinstance(child, ast.withitem) else child
                    below = _lines(head) if inside and isinstance(head, ast.expr) else None
                    simple = not isinstance(node, ast.stmt) or not hasattr(node, "body")
                    yield from self.of(child, reach if simple else below, inside)

    def of_function(self, node: ast.FunctionDef | ast.AsyncFunctionDef) -> Iterator[Change]:
        body = node.body[1:] if ast.get_docstring(node, clean=False) is not None else node.body
        if not body:
            return
        for default in [*node.args.defaults, *node.args.kw_defaults]:
            if default is not None:
                yield from self.of(default, _lines(body[0]))
        yield from self.of_statements(body, None, inside=True)

    def of_expression(self, node: ast.expr, reach: tuple[int, int] | None) -> Iterator[Change]:
        """Changes of an expression itself, without what is in it."""
        if isinstance(node, ast.Compare):
            for left, operator, right in zip(
                [node.left, *node.comparators], node.ops, node.comparators
            ):
                yield from self.between(left, right, COMPARISONS[type(operator)], reach)
        elif isinstance(node, ast.BoolOp):
            for left, right in zip(node.values, node.values[1:]):
                yield from self.between(left, right, OPERATORS[type(node.op)], reach)
        elif isinstance(node, ast.BinOp) and type(node.op) in OPERATORS and not _joins(node):
            typed = isinstance(node.op, ast.BitOr) and reach is None  # `int | str` in a module
            if not typed:
                yield from self.between(node.left, node.right, OPERATORS[type(node.op)], reach)
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, (ast.Not, ast.USub)):
            words = 3 if isinstance(node.op, ast.Not) else 1
            start = self.place(node.lineno, node.col_offset)
            yield Change(start, start + words, "" if words == 3 else "+", node.lineno, reach)
        elif isinstance(node, ast.Constant):
            for other in _others(node.value) if self.numbers else _flipped(node.value):
                yield self.replaced(node, other, reach)

    def between(
        self,
        left: ast.expr,
        right: ast.expr,
        texts: tuple[str, str],
        reach: tuple[int, int] | None,
    ) -> Iterator[Change]:
        """The change of an operator that stands between two expressions."""
        assert left.end_lineno is not None
        assert left.end_col_offset is not None
        begin = self.place(left.end_lineno, left.end_col_offset)
        end = self.place(right.lineno, right.col_offset)
        pattern = r"\s+".join(map(re.escape, texts[0].split())).encode()
        found = re.search(pattern, self.data[begin:end])
        if found is not None:
            line = left.end_lineno + self.data[begin : begin + found.start()].count(b"\n")
            yield Change(begin + found.start(), begin + found.end(), texts[1], line, reach)

    def replaced(
        self, node: ast.expr | ast.stmt, after: str, reach: tuple[int, int] | None
    ) -> Change:
        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        start = self.place(node.lineno, node.col_offset)
        end = self.place(node.end_lineno, node.end_col_offset)
        return Change(start, end, after, node.lineno, reach)

    def place(self, line: int, column: int) -> int:
        return self.begins[line - 1] + column


def _lines(node: ast.expr | ast.stmt) -> tuple[int, int]:
    return node.lineno, node.end_lineno or node.lineno


def _is_text(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, str)


def _joins(node: ast.BinOp) -> bool:
    """Whether texts or sequences are joined or repeated, which has no sign."""
    return any(
        isinstance(side, SEQUENCES)
        or _is_text(side)
        or (isinstance(side, ast.BinOp) and _joins(side))
        for side in (node.left, node.right)
    )


def _flipped(value: object) -> tuple[str, ...]:
    return (str(not value),) if isinstance(value, bool) else ()


def _others(value: object) -> tuple[str, ...]:
    """What a number, True or False becomes; a float is doubled, as one more may be anything."""
    if isinstance(value, bool):
        return _flipped(value)
    if isinstance(value, int):
        return tuple(dict.fromkeys(map(str, (value + 1, 2 * value or 1))))
    if isinstance(value, float):
        return (repr(2 * value or 1.0),)
    return ()
