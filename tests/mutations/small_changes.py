"""All small wrong changes that can be made to Python files by rule, and a random choice of them."""

from __future__ import annotations

import ast
import random
import re
from collections.abc import Iterator
from itertools import islice, pairwise
from pathlib import Path

from changes import Change

COMPARISONS: dict[type[ast.cmpop], tuple[str, str]] = {
    ast.Lt: ("<", "<="), ast.LtE: ("<=", "<"), ast.Gt: (">", ">="), ast.GtE: (">=", ">"),
    ast.Eq: ("==", "!="), ast.NotEq: ("!=", "=="), ast.Is: ("is", "is not"),
    ast.IsNot: ("is not", "is"), ast.In: ("in", "not in"), ast.NotIn: ("not in", "in"),
}  # fmt: skip

REVERSED: dict[type[ast.cmpop], tuple[str, str]] = {
    ast.Lt: ("<", ">"), ast.LtE: ("<=", ">="), ast.Gt: (">", "<"), ast.GtE: (">=", "<="),
}  # fmt: skip

ARITHMETIC: dict[type[ast.operator], tuple[str, str]] = {
    ast.Add: ("+", "-"), ast.Sub: ("-", "+"), ast.Mult: ("*", "/"), ast.Div: ("/", "*"),
    ast.FloorDiv: ("//", "/"), ast.Mod: ("%", "+"), ast.Pow: ("**", "*"),
    ast.BitAnd: ("&", "|"), ast.BitOr: ("|", "&"),
}  # fmt: skip

NAMES = {
    "min": "max", "max": "min", "amin": "amax", "amax": "amin", "minimum": "maximum",
    "maximum": "minimum", "any": "all", "all": "any", "floor": "ceil", "ceil": "floor",
    "sin": "cos", "cos": "sin", "sum": "mean", "mean": "sum", "width": "height", "height": "width",
}  # fmt: skip

PLAIN = "min", "max", "any", "all", "width", "height"
"""Those that are there without a module or an object before them."""

_OMITTED = ast.JoinedStr | ast.Import | ast.ImportFrom | ast.Raise | ast.Assert
"""Not changed: the texts of messages, and what fails in any case."""

Edit = tuple[int, int, str, str]
"""First and last byte, the text that takes their place, and what is wrong with it."""


def edits(source: str) -> list[Edit]:
    """Return all edits of a module's text that can be made by rule."""
    text = _Text(source)
    return sorted({edit for node in _nodes(ast.parse(source)) for edit in _edits(node, text)})


def change_of(file: str, source: str, edit: Edit) -> Change:
    """Return an edit as a change of whole lines."""
    data = source.encode()
    start, end, new, name = edit
    first = data.rfind(b"\n", 0, start) + 1
    last = data.find(b"\n", end)
    last = len(data) if last < 0 else last
    changed = data[first:start] + new.encode() + data[end:last]
    line = data.count(b"\n", 0, first) + 1
    return Change(name, file, data[first:last].decode(), changed.decode(), line)


def sample(root: Path, files: list[str], count: int, seed: int) -> list[Change]:
    """Return so many different changes, chosen at random among all of those files."""
    found = []
    for file in sorted(files):
        source = (root / file).read_text(encoding="utf-8")
        found += [change_of(file, source, edit) for edit in edits(source)]
    random.Random(seed).shuffle(found)
    return list(islice((one for one in found if _can_be_read(root, one)), count))


def _can_be_read(root: Path, change: Change) -> bool:
    """Return whether a change leaves a module: it does not where parentheses stand in its way."""
    try:
        ast.parse(change.applied((root / change.file).read_text(encoding="utf-8")))
    except SyntaxError:
        return False
    return True


class _Text:
    """A module's text, by the places that ``ast`` gives."""

    def __init__(self, source: str) -> None:
        self.data = source.encode()
        self._lines = [0]
        for line in self.data.splitlines(keepends=True):
            self._lines.append(self._lines[-1] + len(line))

    def start(self, node: ast.AST) -> int:
        return self._lines[node.lineno - 1] + node.col_offset  # type: ignore[attr-defined]

    def end(self, node: ast.AST) -> int:
        return self._lines[node.end_lineno - 1] + node.end_col_offset  # type: ignore[attr-defined]

    def of(self, node: ast.AST) -> str:
        return self.data[self.start(node) : self.end(node)].decode()

    def between(self, left: ast.AST, right: ast.AST, old: str, new: str) -> Iterator[Edit]:
        """Replace the operator between two expressions."""
        at, to = self.end(left), self.start(right)
        pattern = r"\s+".join(map(re.escape, old.split())).encode()
        if found := re.search(pattern, self.data[at:to]):
            yield at + found.start(), at + found.end(), new, f"{old} is {new}"


def _nodes(tree: ast.Module) -> Iterator[ast.AST]:
    """Return the nodes that may be changed: no docstrings, annotations, decorators, messages."""
    todo: list[ast.AST] = [tree]
    while todo:
        node = todo.pop()
        yield node
        for name, value in ast.iter_fields(node):
            if name in ("annotation", "returns", "decorator_list", "type_comment", "bases"):
                continue
            children = value if isinstance(value, list) else [value]
            for child in children:
                text = isinstance(child, ast.Expr) and isinstance(child.value, ast.Constant)
                if isinstance(child, ast.AST) and not text and not isinstance(child, _OMITTED):
                    todo.append(child)


def _edits(node: ast.AST, text: _Text) -> Iterator[Edit]:
    if isinstance(node, ast.Compare):
        yield from _comparisons(node, text)
    elif isinstance(node, ast.BinOp) and type(node.op) in ARITHMETIC:
        yield from text.between(node.left, node.right, *ARITHMETIC[type(node.op)])
    elif isinstance(node, ast.BoolOp):
        old, new = ("and", "or") if isinstance(node.op, ast.And) else ("or", "and")
        yield from text.between(node.values[0], node.values[1], old, new)
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not | ast.USub):
        length = 3 if isinstance(node.op, ast.Not) else 1
        yield text.start(node), text.start(node) + length, "", "a sign or 'not' is dropped"
    elif isinstance(node, ast.Constant):
        yield from _constants(node, text)
    elif isinstance(node, ast.Call):
        yield from _calls(node, text)
    elif isinstance(node, ast.If | ast.IfExp | ast.While):
        place = text.start(node.test), text.end(node.test)
        yield *place, f"not ({text.of(node.test)})", "a condition is reversed"
    if isinstance(node, ast.Name | ast.Attribute):
        yield from _names(node, text)
    if _is_droppable(node):
        yield text.start(node), text.end(node), "pass", "a statement is dropped"


def _comparisons(node: ast.Compare, text: _Text) -> Iterator[Edit]:
    left = node.left
    for operator, right in zip(node.ops, node.comparators, strict=True):
        yield from text.between(left, right, *COMPARISONS[type(operator)])
        if type(operator) in REVERSED:
            yield from text.between(left, right, *REVERSED[type(operator)])
        left = right


def _constants(node: ast.Constant, text: _Text) -> Iterator[Edit]:
    place = text.start(node), text.end(node)
    if isinstance(node.value, bool):
        yield *place, str(not node.value), f"{node.value} is {not node.value}"
    elif isinstance(node.value, int | float):
        for new in {node.value + 1, type(node.value)(0)} - {node.value}:
            yield *place, repr(new), f"{node.value} is {new}"


def _calls(node: ast.Call, text: _Text) -> Iterator[Edit]:
    if len(node.args) > 1 and not any(isinstance(a, ast.Starred) for a in node.args[:2]):
        first, second = node.args[:2]
        between = text.data[text.end(first) : text.start(second)].decode()
        swapped = text.of(second) + between + text.of(first)
        yield text.start(first), text.end(second), swapped, "arguments are swapped"
    ends = [*node.args, *node.keywords]
    for before, keyword in pairwise(ends):
        if isinstance(keyword, ast.keyword) and keyword.arg:
            yield text.end(before), text.end(keyword), "", f"{keyword.arg} is as by default"


def _names(node: ast.Name | ast.Attribute, text: _Text) -> Iterator[Edit]:
    plain = isinstance(node, ast.Name)
    old = node.id if isinstance(node, ast.Name) else node.attr
    if old in (PLAIN if plain else NAMES) and isinstance(node.ctx, ast.Load):
        yield text.end(node) - len(old), text.end(node), NAMES[old], f"{old} is {NAMES[old]}"


def _is_droppable(node: ast.AST) -> bool:
    """Return whether the module is likely to go on without a statement."""
    if isinstance(node, ast.Assign):
        return not any(isinstance(target, ast.Name | ast.Tuple) for target in node.targets)
    calls = isinstance(node, ast.Expr) and isinstance(node.value, ast.Call)
    return calls or isinstance(node, ast.AugAssign | ast.Continue | ast.Break)
