"""``uwblite devices``: what is plugged in, and what about it needs mending."""

import argparse
import time
from dataclasses import dataclass, field

from ..drivers.device_options import Options, Setup
from ..drivers.devices import DEVICES, SENSORS, DeviceKind, kinds_on_usb
from ..drivers.events import Action, Note, Reopen, Send, SetBaud, SetDtr
from ..drivers.ports import plugged_in
from ..drivers.session import Session
from ..drivers.transport import Port, check_url, open_port
from ..errors import DeviceError
from .console import note, say, say_json

LISTEN, ASK = 0.6, 5.0
"""s to wait for a device that talks unasked, and for one that answers."""


@dataclass
class PortReport:
    """What was seen on one port."""

    path: str
    kind: str = "unknown"
    found: bool = False
    """Somebody answered."""
    details: dict[str, str] = field(default_factory=dict)
    findings: list[tuple[str, str]] = field(default_factory=list)
    """(level, what and how to mend it)."""


def run(args: argparse.Namespace) -> int:
    """Look at the ports and report."""
    if args.kinds:
        return _list_kinds()
    reports = []
    if args.ports:
        for path in args.ports:
            check_url(path)
        reports = [PortReport(path) if args.list else look(path, [], args.pan_id) for path in args.ports]
    else:
        for port in plugged_in():
            kinds = kinds_on_usb(port.usb_id, port.description)
            port_report = look(port.path, kinds, args.pan_id) if kinds and not args.list else PortReport(port.path)
            port_report.details = {"usb": f"{port.usb_id} {port.description}".strip(), **port_report.details}
            reports.append(port_report)
            if not kinds:
                port_report.findings.append(("info", f"kind not known; `uwblite devices {port.path}` looks at it"))
    if not reports:
        raise DeviceError("no serial device is plugged in; check cables and power, then `dmesg | tail` (see firmware_notes)")
    _compare_networks(reports)
    _report(reports, args.json)
    if not args.ports and not any(":" in port_report.details["usb"].split(" ")[0] for port_report in reports):
        note("no USB device is plugged in; check cables and power, then `dmesg | tail` (see firmware_notes)")
    if any(level != "info" for port_report in reports for level, _ in port_report.findings):
        return 3
    return 0 if args.list or any(port_report.found for port_report in reports) else 1


def _list_kinds() -> int:
    for sensor in SENSORS:
        for kind in DEVICES.values():
            if kind.sensor == sensor:
                say(f"--{sensor} {kind.name}:PORT".ljust(28) + kind.title)
                if kind.options:
                    say(f"    options: {kind.options}")
    return 0


def _report(reports: list[PortReport], as_json: bool) -> None:
    if as_json:
        rows = [
            {
                "port": port_report.path,
                "kind": port_report.kind,
                **port_report.details,
                "findings": [{"level": level, "text": text} for level, text in port_report.findings],
            }
            for port_report in reports
        ]
        say_json({"devices": rows})
        return
    for port_report in reports:
        say(f"{port_report.path}: {port_report.kind}")
        for name, value in port_report.details.items():
            say(f"    {name}: {value}")
        for level, text in port_report.findings:
            say(f"    {level}: {text}")
    if reports and all(port_report.found for port_report in reports) and not any(
        level != "info" for port_report in reports for level, _ in port_report.findings
    ):  # fmt: skip
        note("all is well")


def look(path: str, kinds: list[DeviceKind], pan_id: int | None) -> PortReport:
    """Open a port, find out who is there, and judge its settings.

    Parameters
    ----------
    kinds : of device that it may be; empty = any.
    pan_id : network id that a tag should have, None = any.

    Returns
    -------
    PortReport
    """
    port_report = PortReport(path)
    tried = kinds or [kind for kind in DEVICES.values() if kind.probe]
    try:
        port = open_port(path, tried[0].baud)
    except DeviceError as error:
        port_report.findings.append(("error", str(error)))
        return port_report
    try:
        for kind in sorted(tried, key=lambda kind: not kind.talks):
            port.set_baud(kind.baud)
            if _ask(port, kind, port_report):
                _judge_network(port_report, pan_id)
                return port_report
        known = ", ".join(kind.title for kind in tried)
        silent = f"nobody known answers: is the device powered, and is it one of these: {known}?"
        port_report.findings.append(("error", kinds[0].silent if kinds else silent))
    except DeviceError as error:
        port_report.findings.append(("error", str(error)))
    finally:
        port.close()
    return port_report


def _ask(port: Port, kind: DeviceKind, port_report: PortReport) -> bool:
    """Let a device's session find it; True when it did."""
    driver = kind.make(Options(kind.name, {}), Setup(stream=False))
    session, notes = Session(driver), []

    def do(actions: list[Action]) -> bool:
        for action in actions:
            if isinstance(action, Send):
                port.write(action.data)
            elif isinstance(action, SetBaud):
                port.set_baud(action.rate)
            elif isinstance(action, SetDtr):
                port.set_dtr(action.on)
            elif isinstance(action, Note):
                notes.append(action)
        return not any(isinstance(action, Reopen) for action in actions)

    end = time.monotonic() + (LISTEN if kind.talks else ASK)
    going = do(session.start(time.monotonic()))
    while going and time.monotonic() < end and not driver.ready:
        data = port.read()
        now = time.monotonic()
        going = do(session.feed(data, now)) if data else True
        going = going and do(session.tick(now))
        time.sleep(0.003)
    if not driver.ready:
        port_report.findings += [(note.level, note.text) for note in notes if note.name == "lidar-scip1-only"]
        return False
    do(session.stop())
    identity = driver.identity()
    port_report.found, port_report.kind, port_report.details = True, identity.title, dict(identity.details)
    output = {note.name for note in identity.findings}
    shown = [*identity.findings, *(note for note in notes if note.name not in output)]
    port_report.findings += [(note.level, note.text) for note in shown]
    return True


def _judge_network(port_report: PortReport, pan_id: int | None) -> None:
    network = port_report.details.get("network")
    if pan_id is not None and network not in (None, "0x0000", f"0x{pan_id:04X}"):
        text = f"the network id is {network}: in the shell type `nis 0x{pan_id:04X}`, then `reset`"
        port_report.findings.append(("error", text))


def _compare_networks(reports: list[PortReport]) -> None:
    """Nodes on one computer that are in different networks never reach each other."""
    networks = {port_report.details["network"] for port_report in reports if "network" in port_report.details}
    if len(networks) > 1:
        for port_report in reports:
            if "network" in port_report.details:
                port_report.findings.append(("warning", f"nodes differ in network id ({', '.join(sorted(networks))})"))
