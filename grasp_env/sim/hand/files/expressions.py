"""Evaluate the expressions of xacro files.

Python's own `eval` does not run. `ast` parses the expression, and each node that is allowed has an
entry below. There is none for lambdas, assignments and f-strings. Attributes exist for plain data
and for dicts with dotted names only, so that nothing leads from a value to a class, a frame or a
function's globals. Names of such attributes are refused before anything is evaluated.
"""

from __future__ import annotations

import ast
import operator
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

_PLAIN = (str, int, float, complex, list, tuple, dict, set, frozenset, range)
_HIDDEN = ("format", "format_map")  # their text may name attributes
_MEMBERS = {
    kind: {name for name in dir(kind) if name[0] != "_"}.difference(_HIDDEN) for kind in _PLAIN
}
# names of attributes that lead into the interpreter
_INNER = re.compile(r"__|gi_|cr_|ag_|tb_|f_(back|builtins|code|globals|lasti|lineno|locals|trace)")
_MOST_BITS = 100_000  # of a power or a shift of whole numbers, which can take forever

_UNARY: dict[type[ast.AST], Callable[[Any], Any]] = {
    ast.UAdd: operator.pos,
    ast.USub: operator.neg,
    ast.Not: operator.not_,
    ast.Invert: operator.invert,
}
_BINARY: dict[type[ast.AST], Callable[[Any, Any], Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.FloorDiv: operator.floordiv,
    ast.Mod: operator.mod,
    ast.Pow: operator.pow,
    ast.LShift: operator.lshift,
    ast.RShift: operator.rshift,
    ast.BitAnd: operator.and_,
    ast.BitOr: operator.or_,
    ast.BitXor: operator.xor,
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
    ast.Is: operator.is_,
    ast.IsNot: operator.is_not,
    ast.In: lambda item, all_items: item in all_items,
    ast.NotIn: lambda item, all_items: item not in all_items,
}


class RefusedError(Exception):
    """An expression of a hand's file does something that is not allowed."""


def evaluate(text: str, symbols: Mapping[str, Any]) -> Any:
    """Return the value of an expression with variables and functions by name.

    Raises:
        RefusedError: It has a part that is not allowed.
        SyntaxError, NameError, AttributeError: as in Python; so are other errors of its operations.

    Example:
        >>> evaluate("[side.upper() for side in sides if side != 'middle']", {"sides": ["left", "middle", "right"]})
        ['LEFT', 'RIGHT']
        >>> evaluate("(i for i in [1]).gi_frame", {})
        Traceback (most recent call last):
        RefusedError: the expression '(i for i in [1]).gi_frame' reads the attribute 'gi_frame',
            which is not allowed
    """
    return _Evaluation(text.strip(), symbols).run()


class _Evaluation:
    """The evaluation of one expression: a method for each node that is more than an operator."""

    def __init__(self, text: str, symbols: Mapping[str, Any]) -> None:
        self._text = text
        self._symbols = symbols
        self._loops: list[dict[str, Any]] = []  # variables of comprehensions, the innermost last

    def run(self) -> Any:
        tree = ast.parse(self._text, mode="eval")
        for node in ast.walk(tree):
            if isinstance(node, ast.Attribute) and _INNER.match(node.attr):
                raise self._refused(f"reads the attribute {node.attr!r}")
            if isinstance(node, ast.Name) and node.id.startswith("__"):
                raise self._refused(f"reads the name {node.id!r}")
        return self._value(tree.body)

    def _refused(self, what: str) -> RefusedError:
        return RefusedError(f"the expression {self._text[:100]!r} {what}, which is not allowed")

    def _value(self, node: ast.AST) -> Any:
        evaluate_node = _NODES.get(type(node))
        if evaluate_node is None:
            raise self._refused(f"has the Python syntax {type(node).__name__}")
        return evaluate_node(self, node)

    def _items(self, nodes: Iterable[ast.AST]) -> Iterator[Any]:
        """Yield the values of nodes, those of *nodes one by one."""
        for node in nodes:
            if isinstance(node, ast.Starred):
                yield from self._value(node.value)
            else:
                yield self._value(node)

    def _name(self, node: ast.Name) -> Any:
        for variables in reversed(self._loops):
            if node.id in variables:
                return variables[node.id]
        try:
            return self._symbols[node.id]
        except KeyError:
            raise NameError(f"name {node.id!r} is not defined") from None

    def _attribute(self, node: ast.Attribute) -> Any:
        value = self._value(node.value)
        name = node.attr
        for kind, members in _MEMBERS.items():
            if isinstance(value, kind) and name in members:
                return getattr(value, name)
        if isinstance(value, dict) and type(value) is not dict:  # those of xacro have dotted names
            try:
                return value[name]
            except (KeyError, AttributeError):
                raise AttributeError(f"{name!r} is not defined") from None
        raise self._refused(f"reads the attribute {name!r} of type {type(value).__name__}")

    def _call(self, node: ast.Call) -> Any:
        function = self._value(node.func)
        options = dict[str, Any]()
        for keyword in node.keywords:
            value = self._value(keyword.value)
            options.update(value if keyword.arg is None else {keyword.arg: value})
        return function(*self._items(node.args), **options)

    def _binary(self, node: ast.BinOp) -> Any:
        calculate = _BINARY.get(type(node.op))
        if calculate is None:
            raise self._refused(f"has the operator {type(node.op).__name__}")
        left = self._value(node.left)
        right = self._value(node.right)
        if isinstance(left, int) and isinstance(right, int):
            bits = {ast.Pow: left.bit_length() * right, ast.LShift: left.bit_length() + right}
            if bits.get(type(node.op), 0) > _MOST_BITS:
                raise self._refused(f"has a whole number of more than {_MOST_BITS} bits")
        return calculate(left, right)

    def _both(self, node: ast.BoolOp) -> Any:
        value = None
        for operand in node.values:
            value = self._value(operand)
            if bool(value) is isinstance(node.op, ast.Or):
                break
        return value

    def _compare(self, node: ast.Compare) -> Any:
        value = True
        left = self._value(node.left)
        for comparison, operand in zip(node.ops, node.comparators, strict=True):
            right = self._value(operand)
            value = _BINARY[type(comparison)](left, right)
            if not value:
                break
            left = right
        return value

    def _slice(self, node: ast.Slice) -> slice:
        bounds = (node.lower, node.upper, node.step)
        return slice(*(None if bound is None else self._value(bound) for bound in bounds))

    def _dict(self, node: ast.Dict) -> dict[Any, Any]:
        values = dict[Any, Any]()
        for key, value_node in zip(node.keys, node.values, strict=True):
            value = self._value(value_node)
            values.update(value if key is None else {self._value(key): value})
        return values

    def _listed(self, node: ast.ListComp | ast.SetComp | ast.GeneratorExp) -> list[Any]:
        """Return all values of a comprehension; a generator is a list, too: nothing is endless."""
        return self._looped(node.generators, lambda: self._value(node.elt))

    def _dict_listed(self, node: ast.DictComp) -> dict[Any, Any]:
        return dict(
            self._looped(node.generators, lambda: (self._value(node.key), self._value(node.value)))
        )

    def _looped(self, loops: list[ast.comprehension], value: Callable[[], Any]) -> list[Any]:
        self._loops.append({})
        values = list(self._loop(loops, value))
        self._loops.pop()
        return values

    def _loop(self, loops: list[ast.comprehension], value: Callable[[], Any]) -> Iterator[Any]:
        if not loops:
            yield value()
            return
        loop, *inner = loops
        if loop.is_async:
            raise self._refused("has an async loop")
        for item in self._value(loop.iter):
            self._bind(loop.target, item)
            if all(self._value(test) for test in loop.ifs):
                yield from self._loop(inner, value)

    def _bind(self, target: ast.AST, item: Any) -> None:
        if isinstance(target, ast.Name):
            self._loops[-1][target.id] = item
        elif isinstance(target, ast.Tuple | ast.List):
            for inner, value in zip(target.elts, item, strict=True):
                self._bind(inner, value)
        else:
            raise self._refused("assigns in a loop to something that is no name")


_NODES: dict[type[ast.AST], Callable[[_Evaluation, Any], Any]] = {
    ast.Constant: lambda run, node: node.value,
    ast.Name: _Evaluation._name,
    ast.Attribute: _Evaluation._attribute,
    ast.Call: _Evaluation._call,
    ast.UnaryOp: lambda run, node: _UNARY[type(node.op)](run._value(node.operand)),
    ast.BinOp: _Evaluation._binary,
    ast.BoolOp: _Evaluation._both,
    ast.Compare: _Evaluation._compare,
    ast.IfExp: lambda run, node: run._value(node.body if run._value(node.test) else node.orelse),
    ast.Subscript: lambda run, node: run._value(node.value)[run._value(node.slice)],
    ast.Slice: _Evaluation._slice,
    ast.List: lambda run, node: list(run._items(node.elts)),
    ast.Tuple: lambda run, node: tuple(run._items(node.elts)),
    ast.Set: lambda run, node: set(run._items(node.elts)),
    ast.Dict: _Evaluation._dict,
    ast.ListComp: _Evaluation._listed,
    ast.GeneratorExp: _Evaluation._listed,
    ast.SetComp: lambda run, node: set(run._listed(node)),
    ast.DictComp: _Evaluation._dict_listed,
}
