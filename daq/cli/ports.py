"""``rig ports``: which serial ports there are, and who answers."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from daq.cli import terminal as console
from daq.serial.messages import Welcome
from daq.serial.ports import Inquiry, PortFacts, inquire, ports_of


def ports_command(names: list[str], unasked: bool, baud: int, as_json: bool) -> None:
    """List ports, those named or all, and ask who is there unless ``unasked``."""
    ports = ports_of(names)
    inquiries = [Inquiry(port) for port in ports] if unasked else inquire(ports, baud)
    if as_json:
        documents = [_document(inquiry, unasked) for inquiry in inquiries]
        console.print_json({"ports": documents})
        return
    if not inquiries:
        console.print_line(
            "No serial port has hardware behind it. Plug the device in, or start 'rig emulate' "
            "and name the port that it prints:  rig ports PORT"
        )
        return
    console.print_table(
        "Serial ports",
        ["port", "what it is", "who answers"],
        [[_name(i.port), _description(i.port), _answer(i, unasked)] for i in inquiries],
        text=["what it is", "who answers"],
    )
    answered = [inquiry.port for inquiry in inquiries if inquiry.welcome is not None]
    if answered:
        console.print_next(f"rig run prbs.yaml --rig serial.yaml --port {_name(answered[0])}")


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
