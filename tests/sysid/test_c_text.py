"""Plain Python to C: what it means the same in both, and what is refused."""

import math
import shutil
import subprocess

import pytest

from sysid.engine.c_text import CTextError, c_text
from sysid.engine.scalar_text import ScalarEquations
from sysid.examples import lag

CC = shutil.which("gcc")
TEXT = '''
LIMIT = 3
SHARE = 0.25


def powers(a: float, b: float, n: int, s: Array) -> float:
    """Sums, choices, loops."""
    total = 0.0
    for k in range(1, n):
        if k == LIMIT and not a > b:
            s[0] += 1.0
        elif k > LIMIT or a < -1.0:
            total = total - k / n
        else:
            total += a ** 2 + b ** k
    whole, part = n + 2, SHARE
    return (total if a > 0.0 else -total) + a % b + a // b + min(a, b, part) + max(whole, 1)


def unused(a: float) -> float:
    return math.gamma(a)
'''


@pytest.mark.skipif(CC is None, reason="no C compiler")
@pytest.mark.parametrize("a", [-2.5, -0.5, 0.7, 2.5])
def test_c_computes_what_python_does(tmp_path, a):
    scope = {"math": math, "Array": list}
    exec(TEXT, scope)
    memory = [0.0]
    expected = scope["powers"](a, 1.5, 6, memory), memory[0]
    main = f"int main(void) {{ real s[1] = {{0}}; double r = powers({a}, 1.5, 6, s);\n"
    main += 'printf("%.17g %.17g", r, s[0]); return 0; }\n'
    source = f"#include <math.h>\n#include <stdio.h>\n{c_text(TEXT, ['powers'])}\n{main}"
    (tmp_path / "a.c").write_text(source)
    flags = ["-std=c99", "-Wall", "-Wextra", "-Werror"]
    subprocess.run([CC, *flags, "a.c", "-lm", "-o", "a"], cwd=tmp_path, check=True)
    done = subprocess.run(["./a"], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert [float(word) for word in done.stdout.split()] == pytest.approx(expected, rel=1e-14)


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ("return [a]", "[a] has no C here"),
        ("while a > 0.0:\n        a -= 1.0", "While has no C"),
        ("return math.gamma(a)", "math.gamma has no C"),
        ("return a if 0.0 < a < 1.0 else 0.0", "0.0 < a < 1.0 has no C"),
    ],
)
def test_what_has_no_c_is_named_with_its_line(body, words):
    with pytest.raises(CTextError, match="line 2: ") as refused:
        c_text(f"def f(a: float) -> float:\n    {body}\n", ["f"])
    assert words in str(refused.value)


def test_an_argument_without_a_type_is_refused():
    with pytest.raises(CTextError, match="its type must be one of float, int, Array"):
        c_text("def f(a) -> float:\n    return a\n", ["f"])


def test_equations_with_conditions_become_choices():
    model = lag()

    def derivative(x, u, p):
        return ((u[0] - x[0]) / p[1] if x[0] > 0.0 else u[0],)

    from dataclasses import replace

    scope = {"Array": list}
    exec(ScalarEquations(replace(model, derivative=derivative)).slopes(), scope)
    for x in (-1.0, 2.0):
        slopes = [0.0]
        scope["slopes"]([x], [0.5], [1.0, 0.05], slopes)
        assert slopes == list(derivative([x], [0.5], [1.0, 0.05]))
