# mypy: ignore-errors
"""Runs of plain assignments in a kernel's text, written as the machine's instructions directly.

A kernel is thousands of operations on floats, and Numba finds out of each what it is as if it
could be anything: most of the time of a compilation. Within a run of assignments there is little
to find out. ``outlined`` puts a call in the place of each run, of an intrinsic that writes its
instructions; the loops, the arrays and all else are left to Numba.

A conditional expression computes both of its values and takes one: nothing raises errors here,
and lanes have no branches. Indices count from the front. Whole powers are products.
"""

import ast
import builtins
import functools
import inspect
import re
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from numba import types
from numba.core import cgutils
from numba.core.errors import TypingError

from sysid.engine.intrinsics import intrinsic

_FEWEST = 4  # statements; a shorter run without calls is compiled as quickly as it stands
_FLOAT, _INT, _BOOL = types.float64, types.int64, types.boolean
_ARITHMETIC = {ast.Add: "add", ast.Sub: "sub", ast.Mult: "mul"}
_COMPARISONS = {
    ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!="
}  # fmt: skip
_BINARY = (*_ARITHMETIC, ast.Div)
_PARSING = threading.Lock()
_RUN = "_run_"  # how the names of runs begin
_EXTREMES = {max: ast.Gt(), min: ast.Lt()}
_BUILTINS = ("abs", "max", "min")


def outlined(text: str, names: Mapping[str, Any]) -> str:
    """A module's text with its runs as functions, called in their place: see ``intrinsics``.

    names: what the module's functions find beside each other.
    """
    module = _parsed(text)
    syntax = _syntax(module, names)
    runs: list[ast.stmt] = []
    for function in _functions(module):
        if not syntax.is_straight(ast.Name(function.name)):
            _Outliner(function, syntax, runs).replace(function.body)
    module.body += runs
    return ast.unparse(ast.fix_missing_locations(module))


def intrinsics(text: str, names: Mapping[str, Any]) -> dict[str, Any]:
    """What takes the place of the runs in an outlined text, by name.

    The text is looked into once something is compiled that calls one.
    """

    @functools.cache
    def parsed() -> tuple[dict[str, ast.FunctionDef], _Syntax]:
        module = _parsed(text)
        return {node.name: node for node in _functions(module)}, _syntax(module, names)

    heads = re.findall(rf"^def ({_RUN}\w+)\((.*)\):$", text, re.MULTILINE)
    return {name: _intrinsic(name, takes.split(", "), parsed) for name, takes in heads}


def _parsed(text: str) -> ast.Module:
    # Two threads that parse at once may fail: https://github.com/python/cpython/issues/106905
    with _PARSING:
        return ast.parse(text)


def _functions(module: ast.Module) -> list[ast.FunctionDef]:
    return [node for node in module.body if isinstance(node, ast.FunctionDef)]


def _syntax(module: ast.Module, names: Mapping[str, Any]) -> "_Syntax":
    """Of runs in a module, which may call what is a run throughout."""
    plain = _Syntax(names)
    straight = {node.name: node for node in _functions(module) if plain.function(node)}
    numbers = {
        node.targets[0].id: node.value.value
        for node in module.body
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.Constant)
    }
    return _Syntax({**names, **straight, **numbers})


class _Syntax:
    """What may stand in a run, given the functions, modules and numbers that have names."""

    def __init__(self, names: Mapping[str, Any]) -> None:
        self.names = names

    def function(self, node: ast.FunctionDef) -> bool:
        """Whether a function is a run that ends with its result."""
        match _without_marks(node.body):
            case [*body, ast.Return(ast.expr() as value)]:
                return self.expression(value) and all(map(self.statement, body))
        return False

    def statement(self, node: ast.stmt) -> bool:
        if isinstance(node, ast.AugAssign):
            plain = type(node.op) in _BINARY
            return plain and self._target(node.target) and self.expression(node.value)
        plain = isinstance(node, ast.Assign) and len(node.targets) == 1
        return plain and self._target(node.targets[0]) and self.expression(node.value)

    def expression(self, node: ast.expr) -> bool:  # noqa: PLR0911
        match node:
            case ast.Name():
                return True
            case ast.Constant(value):
                return type(value) in (int, float)
            case ast.Tuple(items):
                return all(map(self.expression, items))
            case ast.UnaryOp(op, operand):
                return isinstance(op, ast.USub | ast.Not) and self.expression(operand)
            case ast.BinOp(left, ast.Pow(), right):
                return self.expression(left) and _whole(right) is not None
            case ast.BinOp(left, op, right):
                return type(op) in _BINARY and self.expression(left) and self.expression(right)
            case ast.BoolOp(_, values):
                return all(map(self.expression, values))
            case ast.Compare(left, [op], [right]):
                both = self.expression(left) and self.expression(right)
                return both and type(op) in _COMPARISONS
            case ast.IfExp(test, body, orelse):
                return all(map(self.expression, (test, body, orelse)))
            case ast.Subscript(ast.Name(), place):
                return self.expression(place)
            case ast.Call(function, arguments, []):
                return self.function_of(function) is not None and all(
                    map(self.expression, arguments)
                )
        return False

    def function_of(self, function: ast.expr) -> Any:
        """What a call calls; None for what a run may not."""
        match function:
            case ast.Name(name):
                return getattr(builtins, name) if name in _BUILTINS else self.names.get(name)
            case ast.Attribute(ast.Name(module), name) if module == "math":
                return getattr(self.names["math"], name, None)
        return None

    def is_straight(self, function: ast.expr) -> bool:
        """Whether what is called stands in the text, and is a run as well."""
        return isinstance(self.function_of(function), ast.FunctionDef)

    def _target(self, node: ast.expr) -> bool:
        match node:
            case ast.Name():
                return True
            case ast.Tuple(items):
                return all(isinstance(item, ast.Name) for item in items)
            case ast.Subscript(ast.Name(), place):
                return self.expression(place)
        return False


def _without_marks(body: Sequence[ast.stmt]) -> list[ast.stmt]:
    """Statements without those that only tell the compiler what to do with their function."""
    return [node for node in body if not isinstance(node, ast.Expr)]


def _whole(node: ast.expr) -> int | None:
    """The whole number that stands there."""
    match node:
        case ast.Constant(int(value)):
            return value
        case ast.UnaryOp(ast.USub(), ast.Constant(int(value))):
            return -value
    return None


def _loaded(node: ast.AST) -> set[str]:
    """Names that are read somewhere in a statement or an expression."""
    names = (part for part in ast.walk(node) if isinstance(part, ast.Name))
    raised = _stored(node) if isinstance(node, ast.AugAssign) else set()
    return raised.union(name.id for name in names if isinstance(name.ctx, ast.Load))


def _stored(node: ast.AST) -> set[str]:
    """Names that are set somewhere in a statement."""
    names = (part for part in ast.walk(node) if isinstance(part, ast.Name))
    return {name.id for name in names if isinstance(name.ctx, ast.Store)}


def _read_first(run: Sequence[ast.stmt]) -> set[str]:
    """Names that a run reads before it sets them itself."""
    needed: set[str] = set()
    assigned: set[str] = set()
    for node in run:
        needed |= _loaded(node) - assigned
        assigned |= _stored(node)
    return needed


class _Outliner:
    """Puts calls in the place of one function's runs."""

    def __init__(self, function: ast.FunctionDef, syntax: _Syntax, runs: list[ast.stmt]) -> None:
        self._syntax, self._runs = syntax, runs
        self._locals = _stored(function) | {argument.arg for argument in function.args.args}
        self._needed = self._needed_in(function.body)

    def replace(self, body: list[ast.stmt]) -> None:
        """Calls in the place of the runs among statements, and of those within them."""
        pieces: list[ast.stmt] = []
        for is_run, statements in self._pieces(body):
            if is_run:
                pieces.append(self._call(statements))
                continue
            pieces += statements
            for inner in map(_inner, statements):
                for part in inner:
                    self.replace(part)
        body[:] = pieces

    def _pieces(self, body: Sequence[ast.stmt]) -> Iterator[tuple[bool, list[ast.stmt]]]:
        """Statements in order, with whether they are a run."""
        run: list[ast.stmt] = []
        for node in body:
            if self._syntax.statement(node):
                run.append(node)
                continue
            yield self._is_worth_it(run), run
            yield False, [node]
            run = []
        yield self._is_worth_it(run), run

    def _is_worth_it(self, run: Sequence[ast.stmt]) -> bool:
        calls = (part for node in run for part in ast.walk(node) if isinstance(part, ast.Call))
        return len(run) >= _FEWEST or any(self._syntax.is_straight(call.func) for call in calls)

    def _needed_in(self, body: Sequence[ast.stmt]) -> set[str]:
        """Names that something reads which has not set them itself."""
        needed: set[str] = set()
        for is_run, statements in self._pieces(body):
            if is_run:
                needed |= _read_first(statements)
                continue
            for node in statements:
                parts = _inner(node)
                heads = [getattr(node, name, None) for name in ("test", "iter")]
                for head in filter(None, heads) if parts else [node]:
                    needed |= _loaded(head)
                needed = needed.union(*map(self._needed_in, parts))
        return needed

    def _call(self, run: list[ast.stmt]) -> ast.stmt:
        takes = sorted(_read_first(run) & self._locals)
        leaves = sorted(set().union(*map(_stored, run)) & self._needed)
        name = f"{_RUN}{len(self._runs)}"
        self._runs.append(_function(name, takes, run, leaves))
        call = ast.Call(ast.Name(name), [ast.Name(n) for n in takes], [])
        return ast.Assign([_names(leaves, ast.Store())], call) if leaves else ast.Expr(call)


def _function(
    name: str, takes: Sequence[str], run: Sequence[ast.stmt], leaves: Sequence[str]
) -> ast.stmt:
    """A function of names that does what a run does and gives what it leaves."""
    arguments = ast.arguments([], [ast.arg(n) for n in takes], None, [], [], None, [])
    return ast.FunctionDef(name, arguments, [*run, ast.Return(_names(leaves, ast.Load()))], [])


def _names(names: Sequence[str], use: ast.expr_context) -> ast.Tuple:
    return ast.Tuple([ast.Name(name, use) for name in names], use)


def _inner(node: ast.stmt) -> list[list[ast.stmt]]:
    """Lists of statements within a statement."""
    return [part for name in ("body", "orelse") if (part := getattr(node, name, None))]


def _intrinsic(
    name: str,
    takes: Sequence[str],
    parsed: Callable[[], tuple[Mapping[str, ast.FunctionDef], _Syntax]],
) -> Any:
    """What does as a run does."""

    def results(writer: "_Writer", values: Sequence[Any]) -> tuple[Any, ...]:
        functions, syntax = parsed()
        return _Frame(writer, {}, syntax).result(functions[name], values)

    def code(context: Any, *arguments: Any) -> Any:
        writer = _Writer(context)
        kinds = [_plain(kind) for kind in arguments]
        leaves = results(writer, [writer.taken(kind) for kind in kinds])
        result = _kind(leaves) if leaves else types.none

        def generate(target: Any, builder: Any, signature: Any, given: Any) -> Any:
            writer = _Writer(context, target, builder)
            held = writer.held(results(writer, [*map(writer.taken, kinds, given)]))
            return held if leaves else target.get_dummy_value()

        return result(*kinds), generate

    # Arguments by their names: what stands behind a star would come as one tuple.
    kind = inspect.Parameter.POSITIONAL_OR_KEYWORD
    names = [inspect.Parameter(argument, kind) for argument in ("context", *takes)]
    code.__signature__ = inspect.Signature(names)
    return intrinsic(code)


def _plain(kind: Any) -> Any:
    """The type by which a run takes what has a type."""
    kind = types.unliteral(kind)
    return _INT if isinstance(kind, types.Integer) else kind


@dataclass(frozen=True)
class _Value:
    """A number or an array: its type and, where instructions are written, what holds it."""

    kind: Any
    held: Any = None


class _Writer:
    """Finds the types of a run's numbers and, given a builder, writes instructions.

    Tuples are Python's own, of values.
    """

    def __init__(self, typing: Any, target: Any = None, builder: Any = None) -> None:
        self._typing, self._target, self._builder = typing, target, builder
        self._signatures: dict[tuple[Any, ...], Any] = {}

    def taken(self, kind: Any, held: Any = None) -> Any:
        """What a run is given: a number, an array or a tuple of numbers."""
        if isinstance(kind, types.BaseTuple):
            items = [None] * len(kind)
            if self._builder:
                items = cgutils.unpack_tuple(self._builder, held, len(kind))
            return tuple(map(self.taken, kind, items))
        if self._builder and isinstance(kind, types.Array):
            held = self._target.make_array(kind)(self._target, self._builder, held)
        return _Value(kind, held)

    def held(self, value: Any) -> Any:
        """What holds a number or a tuple of numbers."""
        if not isinstance(value, tuple):
            return value.held
        items = [*map(self.held, value)]
        return self._target.make_tuple(self._builder, _kind(value), items)

    def constant(self, number: float) -> _Value:
        kind = _INT if isinstance(number, int) else _FLOAT
        held = self._target.get_constant(kind, number) if self._builder else None
        return _Value(kind, held)

    def float(self, value: _Value) -> _Value:
        """A number as a float."""
        if value.kind == _FLOAT:
            return value
        return self.write("sitofp", _FLOAT, value, self._value_type(_FLOAT))

    def arithmetic(self, operator: ast.operator, a: Any, b: Any) -> Any:
        """Sum, difference, product or quotient; of tuples, both together."""
        if isinstance(a, tuple):
            return a + b
        if isinstance(operator, ast.Div):
            return self.write("fdiv", _FLOAT, self.float(a), self.float(b))
        name = _ARITHMETIC[type(operator)]
        if a.kind == b.kind == _INT:
            return self.write(name, _INT, a, b, flags=("nsw",))
        return self.write(f"f{name}", _FLOAT, self.float(a), self.float(b))

    def power(self, base: _Value, exponent: int) -> _Value:
        square, result = self.float(base), None
        rest = abs(exponent)
        while rest:
            if rest & 1:
                result = square if result is None else self.arithmetic(ast.Mult(), result, square)
            rest >>= 1
            square = self.arithmetic(ast.Mult(), square, square) if rest else square
        if result is None:
            return self.constant(1.0)
        return self.arithmetic(ast.Div(), self.constant(1.0), result) if exponent < 0 else result

    def negative(self, value: _Value) -> _Value:
        if value.kind == _INT:
            return self.write("neg", _INT, value)
        return self.write("fneg", _FLOAT, value)

    def comparison(self, operator: ast.cmpop, a: _Value, b: _Value) -> _Value:
        sign = _COMPARISONS[type(operator)]
        if a.kind == b.kind == _INT:
            return self._compared("icmp_signed", sign, a, b)
        method = "fcmp_unordered" if sign == "!=" else "fcmp_ordered"
        return self._compared(method, sign, self.float(a), self.float(b))

    def choice(self, condition: _Value, a: _Value, b: _Value) -> _Value:
        if a.kind != b.kind:
            a, b = self.float(a), self.float(b)
        return self.write("select", a.kind, condition, a, b)

    def logical(self, method: str, a: _Value, b: _Value) -> _Value:
        return self.write(method, _BOOL, a, b)

    def opposite(self, value: _Value) -> _Value:
        return self.write("not_", _BOOL, value)

    def element(self, array: _Value, places: Sequence[_Value]) -> _Value:
        """A number in an array."""
        return self.write("load", array.kind.dtype, _Value(None, self._pointer(array, places)))

    def set_element(self, array: _Value, places: Sequence[_Value], value: _Value) -> None:
        value = self.float(value) if array.kind.dtype == _FLOAT else value
        self.write("store", None, value, _Value(None, self._pointer(array, places)))

    def call(self, function: Any, arguments: Sequence[Any]) -> Any:
        """The result of a function that Numba knows or compiles."""
        kinds = tuple(_kind(argument) for argument in arguments)
        key = function, kinds
        if key not in self._signatures:
            kind = self._typing.resolve_value_type(function)
            signature = self._typing.resolve_function_type(kind, kinds, {})
            if signature is None:
                raise TypingError(f"{function} cannot be called with {kinds}")
            called = self._target.get_function(kind, signature) if self._builder else None
            self._signatures[key] = signature, called
        signature, called = self._signatures[key]
        if not self._builder:
            return self.taken(signature.return_type)
        held = [
            self._cast(argument, kind)
            for argument, kind in zip(arguments, signature.args, strict=True)
        ]
        return self.taken(signature.return_type, called(self._builder, held))

    def write(self, method: str, kind: Any, *operands: Any, **options: Any) -> _Value:
        """One instruction."""
        if not self._builder:
            return _Value(kind)
        held = [part.held if isinstance(part, _Value) else part for part in operands]
        return _Value(kind, getattr(self._builder, method)(*held, **options))

    def _compared(self, method: str, sign: str, a: _Value, b: _Value) -> _Value:
        held = getattr(self._builder, method)(sign, a.held, b.held) if self._builder else None
        return _Value(_BOOL, held)

    def _value_type(self, kind: Any) -> Any:
        return self._target.get_value_type(kind) if self._builder else None

    def _pointer(self, array: _Value, places: Sequence[_Value]) -> Any:
        if not self._builder:
            return None
        held = [place.held for place in places]
        return cgutils.get_item_pointer(self._target, self._builder, array.kind, array.held, held)

    def _cast(self, argument: Any, kind: Any) -> Any:
        """What an argument of a call is held by, as the type that the function takes."""
        return self._target.cast(self._builder, self.held(argument), _kind(argument), kind)


def _kind(argument: Any) -> Any:
    """The type of a value or a tuple of values."""
    if isinstance(argument, tuple):
        return types.Tuple([_kind(item) for item in argument])
    return argument.kind


class _Frame:
    """The names of a run, or of a function that it calls, and what they stand for."""

    def __init__(self, writer: _Writer, values: dict[str, Any], syntax: _Syntax) -> None:
        self.values = values
        self._writer, self._syntax = writer, syntax

    def execute(self, node: ast.stmt) -> None:
        if isinstance(node, ast.AugAssign):
            read = ast.BinOp(node.target, node.op, node.value)
            self._assign(node.target, self.value(read))
        else:
            self._assign(node.targets[0], self.value(node.value))

    def value(self, node: ast.expr) -> Any:  # noqa: PLR0911
        """The value of an expression."""
        writer = self._writer
        match node:
            case ast.Name(name):
                values = self.values
                number = self._syntax.names.get(name)
                return values[name] if name in values else writer.constant(number)
            case ast.Constant(number):
                return writer.constant(number)
            case ast.Tuple(items):
                return tuple(map(self.value, items))
            case ast.UnaryOp(ast.USub(), operand):
                return writer.negative(self.value(operand))
            case ast.UnaryOp(ast.Not(), operand):
                return writer.opposite(self.value(operand))
            case ast.BinOp(left, ast.Pow(), right):
                return writer.power(self.value(left), _whole(right))
            case ast.BinOp(left, operator, right):
                return writer.arithmetic(operator, self.value(left), self.value(right))
            case ast.BoolOp(operator, conditions):
                method = "and_" if isinstance(operator, ast.And) else "or_"
                join = functools.partial(writer.logical, method)
                return functools.reduce(join, map(self.value, conditions))
            case ast.Compare(left, [operator], [right]):
                return writer.comparison(operator, self.value(left), self.value(right))
            case ast.IfExp(test, body, orelse):
                return writer.choice(*map(self.value, (test, body, orelse)))
            case ast.Subscript(array, place):
                return self._item(self.value(array), place)
            case ast.Call(function, arguments):
                return self._result(function, [*map(self.value, arguments)])
        raise NotImplementedError(ast.unparse(node))

    def _item(self, array: Any, place: ast.expr) -> Any:
        if isinstance(array, tuple):
            return array[_whole(place)]
        return self._writer.element(array, self._places(place))

    def _places(self, place: ast.expr) -> list[_Value]:
        index = self.value(place)
        return [*index] if isinstance(index, tuple) else [index]

    def _result(self, function: ast.expr, arguments: Sequence[Any]) -> Any:
        called = self._syntax.function_of(function)
        if called in (max, min):
            return functools.reduce(functools.partial(self._extreme, called), arguments)
        if isinstance(called, ast.FunctionDef):
            return self.result(called, arguments)
        return self._writer.call(called, arguments)

    def result(self, function: ast.FunctionDef, arguments: Sequence[Any]) -> Any:
        """What a function of the text gives."""
        names = [argument.arg for argument in function.args.args]
        *body, last = _without_marks(function.body)
        inner = _Frame(self._writer, dict(zip(names, arguments, strict=True)), self._syntax)
        for node in body:
            inner.execute(node)
        return inner.value(last.value)

    def _extreme(self, function: Any, first: _Value, second: _Value) -> _Value:
        """As Python has it: of what does not compare, the first."""
        better = self._writer.comparison(_EXTREMES[function], second, first)
        return self._writer.choice(better, second, first)

    def _assign(self, target: ast.expr, value: Any) -> None:
        match target:
            case ast.Name(name):
                self.values[name] = value
            case ast.Tuple(items):
                for item, part in zip(items, value, strict=True):
                    self._assign(item, part)
            case ast.Subscript(ast.Name(name), place):
                self._writer.set_element(self.values[name], self._places(place), value)
