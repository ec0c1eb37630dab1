"""Identified parameters as a LaTeX table."""

from collections.abc import Sequence

from daq import notation
from daq.identification.rows import ParameterRow, QuantityRow, Rows, mean_errors

_RULES = r"""% With \usepackage{booktabs} its rules are those of booktabs, without it plain ones.
\providecommand{\toprule}{\hline}
\providecommand{\midrule}{\hline}
\providecommand{\bottomrule}{\hline}
"""
_SIGNS = str.maketrans({"<": r"\ensuremath{<}", ">": r"\ensuremath{>}", "±": r"\ensuremath{\pm}"})


def latex(rows: Rows) -> str:
    """Parameters and combinations, without meanings where no parameter has one."""
    quantities: Sequence[QuantityRow] = (*rows.parameters, *rows.combinations)
    heads = ["Parameter", "Meaning", "Value", r"95\,\% interval", "Unit"]
    table, columns = [heads, *map(_cells, quantities)], "llrrl"
    if not any(row.description for row in rows.parameters):
        table, columns = [[cells[0], *cells[2:]] for cells in table], "lrrl"
    return _tabular("Parameters of an identification", "parameters.tex", table, columns)


def latex_errors(rows: Rows) -> str:
    """Errors of each output in training and validation, mean over the logs."""
    heads = ["Output", "Data", r"RMSE / $\max|y|$", "RMSE", "Unit", r"Fit [\%]"]
    table = [heads]
    for part, logs in rows.logs.items():
        for name, errors in mean_errors(logs).items():
            figures = (errors.rmse, errors.rmse_absolute, errors.fit_percent)
            relative, absolute, fit = (
                notation.number_tex(notation.number(value, 3)) for value in figures
            )
            unit = notation.unit_tex(errors.unit)
            table.append([notation.tex(name), part, relative, absolute, unit, fit])
    return _tabular("Errors of an identification", "errors.tex", table, "llrrlr")


def _tabular(content: str, file: str, table: Sequence[Sequence[str]], columns: str) -> str:
    """A table, heads first."""
    head, *body = (" & ".join(cells) + " \\\\\n" for cells in table)
    return (
        f"% {content}: \\input{{{file}}} where the table is to stand.\n{_RULES}"
        f"\\begin{{tabular}}{{{columns}}}\n\\toprule\n{head}\\midrule\n{''.join(body)}"
        "\\bottomrule\n\\end{tabular}\n"
    )


def _cells(row: QuantityRow) -> list[str]:
    return [
        notation.tex(row.name),
        notation.escape_tex(row.description if isinstance(row, ParameterRow) else ""),
        notation.number_tex(row.text(row.value)),
        _interval(row),
        notation.unit_tex(row.unit),
    ]


def _interval(row: QuantityRow) -> str:
    if row.interval is not None:

        def write(end: float) -> str:
            return notation.number_tex(row.text(end))

        return row.interval_text(write, between=" to ", empty="--").translate(_SIGNS)
    if not isinstance(row, ParameterRow):
        return notation.escape_tex(row.undetermined_label) or "--"
    if row.tied is not None:
        return f"$=$ {notation.tex(row.tied)}"
    return (notation.escape_tex(row.label) or "--") if row.free else "fixed"
