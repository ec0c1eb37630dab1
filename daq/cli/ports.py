"""``rig ports``: which serial ports there are, and who answers."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated, Any

import typer

from daq.cli import terminal as console
from daq.cli.options import AsJson
from daq.serial.ports import Answer, ask, list_ports, named


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
    ports_command(names or [], unasked, baud, json)


def ports_command(names: list[str], unasked: bool, baud: int, as_json: bool) -> None:
    """List ports, those named or all, and ask who is there unless ``unasked``."""
    ports = named(names) if names else list_ports()
    answers = [Answer(port, None, None) for port in ports] if unasked else ask(ports, baud)
    if as_json:
        console.print_json({"ports": [_document(answer, not unasked) for answer in answers]})
        return
    if not answers:
        console.print_line(
            "No serial port has hardware behind it. Plug the device in, or start 'rig emulate' "
            "and name the port that it prints:  rig ports PORT"
        )
        return
    console.print_table(
        "Serial ports",
        ["port", "what it is", "who answers"],
        [
            [answer.port.lasting_name or answer.port.name, _kind(answer), _says(answer, unasked)]
            for answer in answers
        ],
        text=["what it is", "who answers"],
    )
    there = next((answer.port for answer in answers if answer.welcome is not None), None)
    if there is not None:
        port = there.lasting_name or there.name
        console.print_next(f"rig run prbs.yaml --rig serial.yaml --port {port}")


def _document(answer: Answer, asked: bool) -> dict[str, Any]:
    document = asdict(answer.port)
    if asked:
        welcome = answer.welcome
        document["answers"] = None if welcome is None else {
            "device": welcome.device,
            "firmware": welcome.firmware,
            "serial_number": welcome.serial,
            "protocol_version": welcome.version,
            "clock_hz": welcome.clock,
            "max_rate_hz": welcome.max_rate,
            "queue": welcome.queue,
            "outputs_held_at_zero_by": welcome.latch.name.lower(),
            "channels": [asdict(channel) for channel in welcome.channels],
        }  # fmt: skip
        document["problem"] = answer.problem
    return document


def _kind(answer: Answer) -> str:
    port = answer.port
    facts = [port.description]
    if port.lasting_name is not None:
        facts.append(f"now {port.name}")
    if port.usb is not None:
        facts.append(f"USB {port.usb}")
    if port.latency_timer is not None:
        facts.append(f"latency timer {port.latency_timer} ms")
    return ", ".join(fact for fact in facts if fact)


def _says(answer: Answer, unasked: bool) -> str:
    if answer.welcome is not None:
        welcome = answer.welcome
        return f"{welcome.device}, firmware {welcome.firmware}, up to {welcome.max_rate:g} Hz"
    return "not asked" if unasked else answer.problem or ""
