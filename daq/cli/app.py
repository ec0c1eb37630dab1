"""The commands of ``rig``, each a module of its own. Heavy imports stay inside the commands."""

import functools
import os
import re
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from inspect import Parameter, cleandoc, signature
from typing import Annotated, Any

from typer import BadParameter, Exit, Option, Typer
from typer.core import TyperGroup

from daq.cli import terminal
from daq.cli.analyse import analyse
from daq.cli.campaign import campaign
from daq.cli.characterise import characterise
from daq.cli.check import check
from daq.cli.design import design
from daq.cli.doctor import doctor
from daq.cli.emulate import emulate
from daq.cli.export import export_c, export_fmu, export_mat, export_mcap, export_parquet
from daq.cli.figures import figures
from daq.cli.identify import identify
from daq.cli.init import init
from daq.cli.interrupt import heeded
from daq.cli.models import models
from daq.cli.ports import ports
from daq.cli.replay import replay
from daq.cli.run import run
from daq.cli.runs import runs
from daq.cli.schema import schema
from daq.cli.scope import scope
from daq.cli.terminal import Volume, output
from daq.cli.tune import tune
from daq.errors import ConfigError

_COMMANDS: tuple[tuple[Callable[..., None], str], ...] = (
    (run, "rig run prbs.yaml --identify"),
    (check, "rig check prbs.yaml --plot check.png"),
    (analyse, "rig analyse runs/20260101T120000Z-constant_velocity"),
    (design, "rig design question.yaml --time 10 --precision 5%"),
    (characterise, "rig characterise simulated.yaml --time 10 --precision 5%"),
    (identify, "rig identify runs/20260101T120000Z-prbs --validate other_log.csv"),
    (campaign, "rig campaign runs/* --model actuator --model actuator:hysteresis=dahl --seeds 0:5"),
    (
        replay,
        "rig replay runs/20260101T120000Z-prbs "
        "--parameters runs/20260101T120000Z-prbs/identification/parameters.yaml",
    ),
    (tune, "rig tune torque.yaml --parameters runs/20260101T120000Z-prbs/identification"),
    (runs, "rig runs protocol=prbs --parameters K_m --sort K_m"),
    (figures, "rig figures runs/20260101T120000Z-prbs --format pdf --format png"),
    (init, "rig init my_rig"),
    (schema, "rig schema schemas"),
    (models, "rig models actuator --identifiable"),
    (emulate, "rig emulate --fault drop=0.01 --fault disconnect@run+0.5"),
    (scope, "rig scope"),
    (ports, "rig ports"),
    (doctor, "rig doctor /dev/ttyACM0"),
)
_EXPORTS: tuple[tuple[str, Callable[..., None], str], ...] = (
    ("mat", export_mat, "rig export mat runs/20260101T120000Z-prbs"),
    ("mcap", export_mcap, "rig export mcap runs/20260101T120000Z-prbs --out prbs.mcap"),
    ("parquet", export_parquet, "rig export parquet runs/20260101T120000Z-prbs"),
    ("fmu", export_fmu, "rig export fmu runs/20260101T120000Z-prbs"),
    ("c", export_c, "rig export c controller.yaml --precision single --out firmware/src"),
)
_COMPUTING = {design, identify, campaign, replay, figures}  # that drive no rig
_QUIET = Option("--quiet", "-q", help="Results and warnings only: no progress, no hints.")
_VERBOSE = Option("--verbose", "-v", help="Also which files and plugins are used.")
_VOLUME_OPTIONS = [
    Parameter(name, Parameter.KEYWORD_ONLY, default=False, annotation=Annotated[bool, option])
    for name, option in (("quiet", _QUIET), ("verbose", _VERBOSE))
]


def _interruptible(command: Callable[..., None]) -> AbstractContextManager[None]:
    return heeded() if command in _COMPUTING else nullcontext()


def _with_volume(function: Callable[..., None]) -> Callable[..., None]:
    """A command that takes ``--quiet`` and ``--verbose`` as well, and keeps to them."""

    @functools.wraps(function)
    def command(*args: Any, quiet: bool, verbose: bool, **options: Any) -> None:
        if quiet and verbose:
            raise BadParameter("give --quiet or --verbose, not both")
        level = Volume.QUIET if quiet else Volume.VERBOSE if verbose else Volume.NORMAL
        with output(level, options.get("json", False)), _interruptible(function):
            _secure_cache()
            function(*args, **options)

    # Typer reads the options from the signature and the annotations.
    plain = signature(function, eval_str=True)
    parameters = [*plain.parameters.values(), *_VOLUME_OPTIONS]
    command.__signature__ = plain.replace(parameters=parameters)  # type: ignore[attr-defined]
    command.__annotations__ = {each.name: each.annotation for each in parameters}
    return command


def _secure_cache() -> None:
    """Have machine code come from nobody else, before anything moves or is computed.

    Raises ConfigError for a RIG_CACHE_DIR that others may write to.
    """
    # Else Numba takes them from a .numba_config.yaml in the working folder, whoever wrote that.
    for name in ("NUMBA_CACHE_DIR", "NUMBA_CACHE_LOCATOR_CLASSES"):
        os.environ.setdefault(name, "")
    if not os.environ.get("RIG_CACHE_DIR"):
        return
    from sysid.engine.compiler import cache_folder
    from sysid.problem.model import ModelError

    try:
        cache_folder()
    except ModelError as error:
        raise ConfigError(str(error)) from None


class _Commands(TyperGroup):
    """The commands; with ``--json`` a mistake in the command line is a document as well."""

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except Exception as error:
            if hasattr(error, "format_message"):  # all that Typer's mistakes share
                terminal.print_json_usage_error(error)
            raise


def _register(group: Typer, name: str | None, command: Callable[..., None], example: str) -> None:
    """Add a command; its docstring is its help, a line for each paragraph."""
    text = re.sub(r"(?<!\n)\n(?!\n)", " ", cleandoc(command.__doc__ or ""))
    group.command(name, help=text, epilog=f"Example:  {example}")(_with_volume(command))


app = Typer(
    name="rig",
    cls=_Commands,
    help=(
        "Excite a hybrid haptic actuator (DC motor and magnetorheological brake), log every "
        "sample, and identify its parameters.\n\n"
        "Start with:  rig run prbs.yaml --identify"
    ),
    no_args_is_help=True,
    rich_markup_mode=None,  # whose frames and columns left texts of 22 letters at 80 columns
    pretty_exceptions_enable=False,
)
for _command, _example in _COMMANDS:
    _register(app, None, _command, _example)
_export = Typer(help="Write what other programs read.", no_args_is_help=True)
for _name, _command, _example in _EXPORTS:
    _register(_export, _name, _command, _example)
app.add_typer(_export, name="export")


@app.callback(invoke_without_command=True)
def program(
    version: Annotated[bool, Option("--version", help="Print the version and exit.")] = False,
) -> None:
    """Nothing but its version, without a command."""
    if version:
        from importlib.metadata import version as installed

        print(f"hybrid-rig {installed('hybrid-rig')}")
        raise Exit
