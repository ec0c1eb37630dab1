"""``rig ports``: which serial ports there are, and who answers."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

import typer

from daq.cli import terminal
from daq.cli.options import AsJson

if TYPE_CHECKING:
    from daq.serial.connection import Inquiry
    from daq.serial.messages import Welcome
    from daq.serial.ports import PortFacts


def ports(
    names: Annotated[
        list[str] | None,
        typer.Argument(metavar="[PORT...]", help="Device names or URLs; default all that exist."),
    ] = None,
    unasked: Annotated[
        bool, typer.Option("--list", help="Send nothing: list the ports without asking.")
    ] = False,
    baud: Annotated[int, typer.Option("--baud", help="Of UARTs; USB does not care.")] = 2_000_000,
    json: AsJson = False,
) -> None:
    """List serial ports, and who answers there."""
    from daq.serial.connection import Inquiry, inquire
    from daq.serial.ports import ports_of

    wanted = ports_of(names or [])
    inquiries = [Inquiry(port) for port in wanted] if unasked else inquire(wanted, baud)
    if json:
        terminal.print_json({"ports": [_document(inquiry, unasked) for inquiry in inquiries]})
    else:
        _show(inquiries, unasked)


def _show(inquiries: list[Inquiry], unasked: bool) -> None:
    if not inquiries:
        terminal.print_line(
            "No serial port has hardware behind it. Plug the device in, or start 'rig emulate' "
            "and name the port that it prints:  rig ports PORT"
        )
        return
    terminal.print_table(
        "Serial ports",
        ["port", "what it is", "who answers"],
        [[_name(i.port), _description(i.port), _answer(i, unasked)] for i in inquiries],
        text=["what it is", "who answers"],
    )
    answered = [inquiry.port for inquiry in inquiries if inquiry.welcome is not None]
    if answered:
        terminal.print_next(f"rig run prbs.yaml --rig serial.yaml --port {_name(answered[0])}")


def _document(inquiry: Inquiry, unasked: bool) -> dict[str, Any]:
    document = asdict(inquiry.port)
    if not unasked:
        document["answers"] = None if inquiry.welcome is None else _identity(inquiry.welcome)
        document["problem"] = inquiry.problem
    return document


def _identity(welcome: Welcome) -> dict[str, Any]:
    return {
        "device": welcome.device,
        "firmware": welcome.firmware,
        "serial_number": welcome.serial,
        "protocol_version": welcome.version,
        "clock_hz": welcome.clock,
        "max_rate_hz": welcome.max_rate,
        "queue": welcome.queue,
        "outputs_held_at_zero_by": welcome.latch.name.lower(),
        "channels": [asdict(channel) for channel in welcome.channels],
    }


def _name(port: PortFacts) -> str:
    return port.lasting_name or port.name


def _description(port: PortFacts) -> str:
    facts = [port.description]
    if port.lasting_name is not None:
        facts.append(f"now {port.name}")
    if port.usb is not None:
        facts.append(f"USB {port.usb}")
    if port.latency_timer is not None:
        facts.append(f"latency timer {port.latency_timer} ms")
    return ", ".join(fact for fact in facts if fact)


def _answer(inquiry: Inquiry, unasked: bool) -> str:
    if inquiry.welcome is not None:
        welcome = inquiry.welcome
        return f"{welcome.device}, firmware {welcome.firmware}, up to {welcome.max_rate:g} Hz"
    return "not asked" if unasked else inquiry.problem or ""
