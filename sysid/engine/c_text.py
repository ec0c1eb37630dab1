"""C99 of plain scalar Python: the text that ``scalar_text`` writes, and laws in the same manner.

What it may have: whole numbers by name, functions of ``float``, ``int`` and ``Array`` (of fixed
size, owned by the caller), assignments, ``if``, ``for`` over a range, ``return``, arithmetic,
comparisons, choices, ``abs``, ``min``, ``max``, ``int`` and the functions of ``math`` that C has
under the same name. Operations keep their order, so double precision gives Python's numbers but for
what the compiler contracts. Nothing but math.h is needed.
"""

import ast
from collections.abc import Mapping, Sequence
from typing import Literal

Precision = Literal["double", "single"]

_TYPES = {"float": "real", "int": "int", "Array": "real *", "None": "void"}
_SIGNS: dict[type, str] = {
    ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.Lt: "<", ast.LtE: "<=",
    ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!=", ast.And: "&&", ast.Or: "||",
    ast.USub: "-", ast.UAdd: "+", ast.Not: "!",
}  # fmt: skip
_MATH_NAMES = """
exp expm1 log log1p log2 log10 sqrt fabs hypot copysign sin cos tan sinh cosh tanh floor ceil
asin acos atan atan2 pow
"""
_MATH = frozenset(_MATH_NAMES.split())
# As Python has them: of equals the first.
_PRELUDE = """\
static inline real least_of(real a, real b) { return b < a ? b : a; }
static inline real most_of(real a, real b) { return b > a ? b : a; }
static inline real modulo(real a, real b) { return a - FLOOR(a / b) * b; }
"""


class CTextError(ValueError):
    """Python that has no C here; it says what and in which line."""

    def __init__(self, node: ast.AST, problem: str) -> None:
        super().__init__(f"line {getattr(node, 'lineno', '?')}: {problem}")


def c_text(text: str, entries: Sequence[str], precision: Precision = "double") -> str:
    """C of a text's functions that ``entries`` call, the others left out; all of them static.

    Raises CTextError.

    >>> c_text("def double(x: float) -> float: return 2.0 * x", ["double"]).splitlines()[-4]
    'static real double_(real x)'
    """
    module = ast.parse(text)
    functions = {node.name: node for node in module.body if isinstance(node, ast.FunctionDef)}
    numbers = {
        node.targets[0].id: ast.literal_eval(node.value)
        for node in module.body
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name)
    }
    needed = _called(functions, entries)
    writers = [
        _Function(node, functions, numbers) for name, node in functions.items() if name in needed
    ]
    bodies = [writer.text() for writer in writers]
    used = set[str]().union(*(writer.numbers_used for writer in writers))
    suffix, kind = ("f", "float") if precision == "single" else ("", "double")
    head = [
        f"typedef {kind} real;",
        f"#define RL(x) x##{suffix}" if suffix else "#define RL(x) x",
        f"#define FLOOR floor{suffix}",
        *(
            f"#define M_{name} {name}{suffix}"
            for name in sorted(_MATH)
            if any(f"M_{name}(" in body for body in bodies)
        ),
    ]
    floats = {k: v for k, v in numbers.items() if k in used and isinstance(v, float)}
    whole = {k: v for k, v in numbers.items() if k in used and k not in floats}
    head += [f"#define {name} RL({value!r})" for name, value in floats.items()]
    enum = ", ".join(f"{name} = {value}" for name, value in whole.items())
    declared = [f"{writer.head()};" for writer in writers]
    parts = ["\n".join(head), _PRELUDE.rstrip(), *([f"enum {{ {enum} }};"] if enum else [])]
    return "\n\n".join([*parts, "\n".join(declared), *bodies])


def c_name(name: str) -> str:
    """A function's name in C, where ``double`` and ``static`` are words of the language."""
    return f"{name}_" if name in _WORDS else name


def numbers_text(kind: str, name: str, values: Sequence[float]) -> str:
    """An array of constants; a number each that C reads back as it is."""
    rows = [values[k : k + 4] for k in range(0, len(values), 4)]
    lines = ",\n".join("    " + ", ".join(f"RL({float(v)!r})" for v in row) for row in rows)
    return f"static const {kind} {name}[{len(values)}] = {{\n{lines}\n}};"


_RESERVED = """
auto break case char const continue default do double else enum extern float for goto if inline int
long register restrict return short signed sizeof static struct switch typedef union unsigned void
volatile while
"""
_WORDS = frozenset(_RESERVED.split())


def _called(functions: Mapping[str, ast.FunctionDef], entries: Sequence[str]) -> set[str]:
    """Names of functions that the entries need, with themselves."""
    needed, waiting = set[str](), list(entries)
    while waiting:
        name = waiting.pop()
        if name in needed:
            continue
        needed.add(name)
        names = (node.id for node in ast.walk(functions[name]) if isinstance(node, ast.Name))
        waiting += [name for name in names if name in functions]
    return needed


class _Function:
    """Writes one function; its locals are whole where all that they are given is."""

    def __init__(
        self,
        node: ast.FunctionDef,
        functions: Mapping[str, ast.FunctionDef],
        numbers: Mapping[str, float],
    ) -> None:
        self._node, self._functions, self._numbers = node, functions, numbers
        self.numbers_used: set[str] = set()
        self._kinds = {arg.arg: _annotation(arg.annotation, arg) for arg in node.args.args}
        self._arguments = dict(self._kinds)
        for part in ast.walk(node):
            if isinstance(part, ast.For) and isinstance(part.target, ast.Name):
                self._kinds[part.target.id] = "int"
        for _ in range(2):  # a number that is whole at first may be given another later
            for part in ast.walk(node):
                if isinstance(part, ast.Assign):
                    self._note(part.targets[0], part.value)

    def head(self) -> str:
        """Its declaration."""
        returns = _TYPES[_annotation(self._node.returns, self._node)]
        written = self._written()
        arguments = ", ".join(
            "const " * (kind == "Array" and name not in written) + _spaced(_TYPES[kind]) + name
            for name, kind in self._arguments.items()
        )
        return f"static {returns} {c_name(self._node.name)}({arguments})"

    def text(self) -> str:
        """All of it."""
        body = self._node.body
        about = ast.get_docstring(self._node)
        if about is not None:
            body = body[1:]
        loops = {
            part.target.id
            for part in ast.walk(self._node)
            if isinstance(part, ast.For) and isinstance(part.target, ast.Name)
        }
        names = [name for name in self._kinds if name not in self._arguments and name not in loops]
        local = [f"    {_TYPES[self._kinds[name]]} {name};" for name in names]
        unused = [f"    (void){name};" for name in self._arguments if not self._reads(name)]
        comment = [f"/* {about} */"] if about else []
        lines = [line for part in body for line in self._statement(part, 1)]
        return "\n".join([*comment, self.head(), "{", *local, *unused, *lines, "}"])

    def _written(self) -> set[str]:
        """Arrays that it writes to, or hands on to what does."""
        written = set()
        for part in ast.walk(self._node):
            if isinstance(part, ast.Subscript) and isinstance(part.ctx, ast.Store):
                assert isinstance(part.value, ast.Name)
                written.add(part.value.id)
            if isinstance(part, ast.Call) and isinstance(part.func, ast.Name):
                callee = self._functions.get(part.func.id)
                if callee is not None and callee is not self._node:
                    inner = _Function(callee, self._functions, self._numbers)._written()
                    written |= {
                        given.id
                        for given, arg in zip(part.args, callee.args.args, strict=True)
                        if isinstance(given, ast.Name) and arg.arg in inner
                    }
        return written

    def _reads(self, name: str) -> bool:
        return any(isinstance(part, ast.Name) and part.id == name for part in ast.walk(self._node))

    def _note(self, target: ast.expr, value: ast.expr) -> None:
        if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
            for part, given in zip(target.elts, value.elts, strict=True):
                self._note(part, given)
        elif isinstance(target, ast.Name) and target.id not in self._arguments:
            kind = "int" if self._whole(value) else "float"
            self._kinds[target.id] = "float" if self._kinds.get(target.id) == "float" else kind

    def _whole(self, node: ast.expr) -> bool:  # noqa: PLR0911
        """Whether an expression is a whole number."""
        match node:
            case ast.Constant(value):
                return isinstance(value, int)
            case ast.Name(name):
                return self._kinds.get(name) == "int" or isinstance(self._numbers.get(name), int)
            case ast.BinOp(left, op, right):
                return not isinstance(op, ast.Div) and self._whole(left) and self._whole(right)
            case ast.UnaryOp(_, operand):
                return self._whole(operand)
            case ast.Call(ast.Name("int")):
                return True
            case ast.Call(ast.Name("min" | "max"), arguments):
                return all(map(self._whole, arguments))
        return False

    def _statement(self, node: ast.stmt, depth: int) -> list[str]:  # noqa: PLR0911
        space = "    " * depth
        match node:
            case ast.Return(None):
                return [f"{space}return;"]
            case ast.Return(value) if value is not None:
                return [f"{space}return {self._value(value)};"]
            case ast.Assign([ast.Tuple(targets)], ast.Tuple(values)):
                pairs = zip(targets, values, strict=True)
                return [f"{space}{self._value(a)} = {self._value(b)};" for a, b in pairs]
            case ast.Assign([target], value):
                return [f"{space}{self._value(target)} = {self._value(value)};"]
            case ast.AugAssign(target, op, value):
                return [f"{space}{self._value(target)} {_SIGNS[type(op)]}= {self._value(value)};"]
            case ast.Expr(value):
                return [f"{space}{self._value(value)};"]
            case ast.If(test, body, orelse):
                lines = [f"{space}if ({self._value(test)}) {{"]
                lines += [line for part in body for line in self._statement(part, depth + 1)]
                if orelse:
                    lines.append(f"{space}}} else {{")
                    lines += [line for part in orelse for line in self._statement(part, depth + 1)]
                return [*lines, f"{space}}}"]
            case ast.For(ast.Name(name), ast.Call(ast.Name("range"), bounds), body):
                first = self._value(bounds[0]) if len(bounds) > 1 else "0"
                last = self._value(bounds[-1] if len(bounds) < 3 else bounds[1])
                lines = [f"{space}for (int {name} = {first}; {name} < {last}; {name}++) {{"]
                lines += [line for part in body for line in self._statement(part, depth + 1)]
                return [*lines, f"{space}}}"]
        raise CTextError(node, f"{type(node).__name__} has no C here")

    def _value(self, node: ast.expr) -> str:  # noqa: PLR0911
        match node:
            case ast.Constant(value) if isinstance(value, int | float):
                return repr(value) if isinstance(value, int) else f"RL({value!r})"
            case ast.Name(name):
                if name in self._numbers:
                    self.numbers_used.add(name)
                return name
            case ast.Subscript(value, place):
                return f"{self._value(value)}[{self._value(place)}]"
            case ast.BinOp(left, op, right):
                return self._operation(node, left, op, right)
            case ast.UnaryOp(op, operand):
                return f"({_SIGNS[type(op)]}{self._value(operand)})"
            case ast.BoolOp(op, values):
                return f"({f' {_SIGNS[type(op)]} '.join(map(self._value, values))})"
            case ast.Compare(left, [op], [right]):
                return f"({self._value(left)} {_SIGNS[type(op)]} {self._value(right)})"
            case ast.IfExp(test, body, orelse):
                return f"({self._value(test)} ? {self._value(body)} : {self._value(orelse)})"
            case ast.Call(function, arguments):
                return self._call(node, function, arguments)
        raise CTextError(node, f"{ast.unparse(node)} has no C here")

    def _operation(self, node: ast.expr, left: ast.expr, op: ast.operator, right: ast.expr) -> str:
        a, b = self._value(left), self._value(right)
        match op:
            case ast.Pow():
                whole = isinstance(right, ast.Constant) and right.value in (2, 2.0)
                return f"({a} * {a})" if whole else f"M_pow({a}, {b})"
            case ast.Mod():
                return f"modulo({a}, {b})"
            case ast.FloorDiv():
                return f"FLOOR({a} / {b})"
            case ast.Div() if self._whole(left) and self._whole(right):
                return f"((real){a} / (real){b})"
        if type(op) not in _SIGNS:
            raise CTextError(node, f"{ast.unparse(node)} has no C here")
        if self._whole(left) != self._whole(right):
            a, b = self._as_real(left, a), self._as_real(right, b)
        return f"({a} {_SIGNS[type(op)]} {b})"

    def _as_real(self, node: ast.expr, text: str) -> str:
        """With the conversion that C makes of a whole number beside a real one, to be seen."""
        return f"(real){text}" if self._whole(node) else text

    def _call(self, node: ast.expr, function: ast.expr, arguments: list[ast.expr]) -> str:
        values = [self._value(argument) for argument in arguments]
        match function:
            case ast.Name("abs"):
                return f"M_fabs({values[0]})"
            case ast.Name("min" | "max" as name):
                if all(map(self._whole, arguments)):
                    (a, b), sign = values, "<" if name == "min" else ">"
                    return f"({b} {sign} {a} ? {b} : {a})"
                pick = "least_of" if name == "min" else "most_of"
                text = values[0]
                for value in values[1:]:
                    text = f"{pick}({text}, {value})"
                return text
            case ast.Name("int" | "float" as name):
                return f"(({_TYPES[name]}){values[0]})"
            case ast.Name(name) if name in self._functions:
                return f"{c_name(name)}({', '.join(values)})"
            case ast.Attribute(ast.Name("math"), name) if name in _MATH:
                return f"M_{name}({', '.join(values)})"
        raise CTextError(node, f"{ast.unparse(function)} has no C here")


def _annotation(node: ast.expr | None, at: ast.AST) -> str:
    text = "" if node is None else ast.unparse(node)
    if text not in _TYPES:
        raise CTextError(at, f"its type must be one of {', '.join(_TYPES)}")
    return text


def _spaced(kind: str) -> str:
    return kind if kind.endswith("*") else f"{kind} "
