"""``rig ports``: which serial ports there are, and who answers."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

from typer import Argument, Option

from daq.cli import options, terminal

if TYPE_CHECKING:
    from daq.serial.connection import Inquiry
    from daq.serial.ports import PortFacts


def ports(
    names: Annotated[
        list[str] | None,
        Argument(metavar="PORT", help="Device names or URLs; default all that exist."),
    ] = None,
    unasked: Annotated[
        bool, Option("--list", help="Send nothing: list the ports without asking.")
    ] = False,
    baud: Annotated[int, Option(metavar="BAUD", help="Of UARTs; USB does not care.")] = 2_000_000,
    json: options.AsJson = False,
) -> None:
    """List serial ports, and who answers there."""
    from daq.serial.connection import Inquiry, inquire
    from daq.serial.ports import ports_of, require_ports

    wanted = ports_of(names or [])
    inquiries = [Inquiry(port) for port in wanted] if unasked else inquire(wanted, baud)
    if json:
        terminal.print_json({"ports": [_document(inquiry, unasked) for inquiry in inquiries]})
    else:
        _show(inquiries, unasked)
    require_ports(names or [])


def _show(inquiries: list[Inquiry], unasked: bool) -> None:
    if not inquiries:
        terminal.print_text(
            "No serial port has hardware behind it. Plug the device in, or start 'rig emulate' "
            "and name the port that it prints:  rig ports PORT"
        )
        return
    head = ["port", "what it is", "who answers"]
    rows = [
        [i.port.lasting_name or i.port.name, _description(i.port), _answer(i, unasked)]
        for i in inquiries
    ]
    terminal.print_table("Serial ports", head, rows, text=head)
    answered = [inquiry.port for inquiry in inquiries if inquiry.welcome is not None]
    if answered:
        port = answered[0].lasting_name or answered[0].name
        terminal.print_next(f"rig run still.yaml --rig serial_tenth.yaml --port {port}")


def _document(inquiry: Inquiry, unasked: bool) -> dict[str, Any]:
    document, welcome = asdict(inquiry.port), inquiry.welcome
    if unasked:
        return document
    document["answers"] = None
    if welcome is not None:
        document["answers"] = {
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
    document["problem"] = inquiry.problem
    return document


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
    welcome = inquiry.welcome
    if welcome is not None:
        return f"{welcome.device}, firmware {welcome.firmware}, up to {welcome.max_rate:g} Hz"
    return "not asked" if unasked else inquiry.problem or ""
